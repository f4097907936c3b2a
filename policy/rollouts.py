"""Independent tasks, each a call of one function: in this process, in processes of this machine, or on Ray."""

from __future__ import annotations

import logging
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import traceback
from itertools import islice
from multiprocessing.connection import wait
from typing import TYPE_CHECKING, Any, TypeVar, cast

from robotcell.errors import CellError, ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable, Generator, Iterable
    from multiprocessing.connection import Connection
    from multiprocessing.context import SpawnProcess
    from types import FrameType

_Task = TypeVar("_Task")
_Result = TypeVar("_Result")

# Workers share the cores between them: libraries that each took all of them would slow each other down.
_ONE_THREAD = dict.fromkeys(
    (
        "OMP_NUM_THREADS",
        "OPENBLAS_NUM_THREADS",
        "MKL_NUM_THREADS",
        "NUMEXPR_NUM_THREADS",
        "OPENCV_FOR_THREADS_NUM",
    ),
    "1",
)
# What a worker has to leave its task's `with` blocks once it was told to end.
_GRACE_S = 10.0
_REACH_S = 5.0


def run_tasks(
    function: Callable[[_Task], _Result],
    tasks: Iterable[_Task],
    workers: int | None = None,
    ray_address: str | None = None,
) -> Generator[tuple[int, _Result], None, None]:
    """Call a function on every task, and yield (number of the task from 0, result) as each call ends.

    A task is taken from `tasks` when a worker is free for it, so that an endless iterable may still react to
    results. A caller that gives up early closes the generator (`contextlib.closing`): no worker outlives it, and
    what a worker had in hand is cut off.

    Args:
        function: of the top level of a module, as it is sent to the workers by name.
        tasks: what can be pickled; so must be the results. A worker imports nothing heavier than what they need.
        workers: how many calls run at once. 1 runs them in this process, more in as many processes with one thread
            each. None: 1, or on Ray as many as it has processors.
        ray_address: of a Ray cluster on which robotcell is installed, or "local" to start Ray on this machine.

    Raises:
        ConfigError: fewer than one worker, Ray is not installed or not there.
        CellError: a worker died; the message says in which task and how.
        Exception: what the function raised, as it raised it, with the number of the task and the traceback as cause.
    """
    if workers is not None and workers < 1:
        raise ConfigError(f"{workers} workers were asked for; at least one has to do the work")
    if ray_address is not None:
        yield from _on_ray(function, tasks, workers, ray_address)
    elif workers is None or workers == 1:
        for index, task in enumerate(tasks):
            yield index, _result(index, _call(function, task))
    else:
        yield from _in_processes(function, tasks, workers)


class _TaskFailed(Exception):
    """The cause of an error that a task raised: which task, and where in it."""


def _call(function: Callable[[_Task], _Result], task: _Task) -> tuple[_Result | None, Exception | None, str]:
    """The result, or the error and its traceback."""
    try:
        return function(task), None, ""
    except Exception as error:  # it is raised again where the tasks come from
        return None, error, traceback.format_exc()


def _result(index: int, reply: tuple[Any, Exception | None, str]) -> Any:
    result, error, trace = reply
    if error is not None:
        raise error from _TaskFailed(f"task {index} failed\n{trace}")
    return result


def _packed(function: Callable[[Any], Any], task: object) -> bytes:
    """What a worker sends back: a reply of `_call`, pickled."""
    reply = _call(function, task)
    try:
        packed = pickle.dumps(reply)
        if reply[1] is not None:
            pickle.loads(packed)
    except Exception as error:  # of pickling, which runs anybody's code
        what = "result" if reply[1] is None else f"error {reply[1]!r}"
        text = f"the {what} of the task cannot be sent to the process that asked for it: {error}"
        return pickle.dumps((None, RuntimeError(text), reply[2]))
    return packed


def _in_processes(
    function: Callable[[Any], Any], tasks: Iterable[Any], workers: int
) -> Generator[tuple[int, Any], None, None]:
    context = multiprocessing.get_context("spawn")
    remaining = enumerate(tasks)
    processes: list[SpawnProcess] = []
    connections: list[Connection] = []
    busy: dict[Connection, tuple[int, SpawnProcess]] = {}

    def assign(index: int, task: object, process: SpawnProcess, connection: Connection) -> None:
        packed = pickle.dumps((function, task))
        try:
            connection.send_bytes(packed)
        except OSError:
            raise _death(index, process) from None
        busy[connection] = index, process

    try:
        for index, task in islice(remaining, workers):
            ours, theirs = context.Pipe()
            connections.append(ours)
            with theirs:
                process = context.Process(target=_serve, args=(theirs,), daemon=True)
                process.start()
            processes.append(process)
            assign(index, task, process, ours)
        while busy:
            for connection in cast("list[Connection]", wait(list(busy))):
                index, process = busy.pop(connection)
                try:
                    reply = pickle.loads(connection.recv_bytes())
                except (EOFError, OSError):
                    raise _death(index, process) from None
                following = next(remaining, None)
                if following is not None:
                    assign(*following, process, connection)
                yield index, _result(index, reply)
    finally:
        _end(processes, connections)


def _end(processes: list[SpawnProcess], connections: list[Connection]) -> None:
    for connection in connections:
        connection.close()
    for process in processes:
        process.terminate()
    for process in processes:
        process.join(_GRACE_S)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()


def _death(index: int, process: SpawnProcess) -> CellError:
    process.join(_GRACE_S)
    code = process.exitcode
    how = f"was killed by {signal.Signals(-code).name}" if code is not None and code < 0 else f"ended with code {code}"
    return CellError(
        f"the worker process of task {index} {how}: if memory ran out, use fewer workers; otherwise run the task "
        "with one worker to see what happens"
    )


def _serve(connection: Connection) -> None:
    """What a worker process does: tasks, until the connection closes."""
    os.environ.update(_ONE_THREAD)
    # An interrupt from the keyboard reaches every process of the terminal; the parent decides what comes of it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Leaves the `with` blocks of the task.
    signal.signal(signal.SIGTERM, _leave)
    try:
        while True:
            try:
                message = connection.recv_bytes()
            except (EOFError, OSError):
                return
            connection.send_bytes(_do(message))
    finally:
        # No block is left to leave: an exception would only disturb what libraries do when the interpreter ends.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _do(message: bytes) -> bytes:
    try:
        function, task = pickle.loads(message)
    except Exception as error:  # of an import, which runs anybody's code
        return pickle.dumps((None, RuntimeError(f"the worker cannot load the task: {error!r}"), traceback.format_exc()))
    return _packed(function, task)


def _leave(number: int, _frame: FrameType | None) -> None:
    sys.exit(128 + number)


def _on_ray(
    function: Callable[[Any], Any], tasks: Iterable[Any], workers: int | None, address: str
) -> Generator[tuple[int, Any], None, None]:
    # Ray reports its use to its makers unless told not to.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ConfigError(f"Ray cannot be imported ({error}): pip install 'robotcell[train]'") from error
    local = address == "local"
    _check_reachable(address)
    try:
        ray.init(
            address=address,
            num_cpus=workers if local else None,
            include_dashboard=False if local else None,
            runtime_env={"env_vars": _ONE_THREAD},
            log_to_driver=False,
            logging_level=logging.WARNING,
        )
    except (ConnectionError, ValueError, RuntimeError) as error:
        raise ConfigError(f"no Ray cluster answers at {address!r} ({error}): check the address") from error
    try:
        processors = ray.cluster_resources().get("CPU", 1)  # type: ignore[no-untyped-call]
        in_flight = workers or max(1, int(processors))
        remote = ray.remote(num_cpus=1)(_packed)
        remaining = enumerate(tasks)
        busy = {remote.remote(function, task): index for index, task in islice(remaining, in_flight)}
        while busy:
            (done,), _ = ray.wait(list(busy), num_returns=1)
            index = busy.pop(done)
            try:
                reply = pickle.loads(ray.get(done))
            except ray.exceptions.RayError as error:
                raise CellError(f"the Ray worker of task {index} failed: {error}") from error
            following = next(remaining, None)
            if following is not None:
                busy[remote.remote(function, following[1])] = following[0]
            yield index, _result(index, reply)
    finally:
        ray.shutdown()


def _check_reachable(address: str) -> None:
    """Ray itself tries an address at which nothing listens for minutes."""
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():
        return
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=_REACH_S).close()
    except (OSError, OverflowError) as error:
        raise ConfigError(f"no Ray cluster answers at {address!r} ({error}): check the address") from error
