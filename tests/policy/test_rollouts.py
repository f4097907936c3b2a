from __future__ import annotations

import atexit
import os
import signal
import socket
import subprocess
import sys
import time
from collections import deque
from contextlib import closing
from itertools import count
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

import psutil
import pytest

from policy.rollouts import run_tasks
from robotcell.errors import CellError, ConfigError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path


@pytest.fixture(autouse=True)
def no_tracker() -> Iterator[None]:
    """multiprocessing keeps a process for resources that these tests do not use until the interpreter ends."""
    yield
    resource_tracker._resource_tracker._stop()


def square(number: int) -> int:
    return number * number


def refuse_three(number: int) -> int:
    if number == 3:
        raise ConfigError("three is not allowed")
    return number


class Unpicklable(Exception):
    def __init__(self, first: str, second: str) -> None:
        super().__init__(first)


def raise_unpicklable(_: int) -> int:
    raise Unpicklable("one", "two")


def threads(_: int) -> tuple[str | None, int]:
    return os.environ.get("OMP_NUM_THREADS"), os.getpid()


def die(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def leave_a_mark_at_the_end(folder: Path) -> None:
    try:
        (folder / f"{os.getpid()}-begun").touch()
        time.sleep(60)
    finally:
        (folder / f"{os.getpid()}-left").touch()


def be_told_to_end_twice(_: int) -> None:
    """The second time while the interpreter ends."""
    atexit.register(os.kill, os.getpid(), signal.SIGTERM)
    os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize("workers", [None, 1, 2])
def test_every_task_gets_its_result_under_its_number(workers: int | None) -> None:
    assert dict(run_tasks(square, range(2, 7), workers)) == {0: 4, 1: 9, 2: 16, 3: 25, 4: 36}
    assert list(run_tasks(square, [], workers)) == []


@pytest.mark.parametrize("workers", [1, 2])
def test_an_error_names_its_task_and_keeps_its_type(workers: int) -> None:
    with pytest.raises(ConfigError, match="three is not allowed") as caught:
        deque(run_tasks(refuse_three, range(6), workers), maxlen=0)
    assert "task 3 failed" in str(caught.value.__cause__)
    assert "in refuse_three" in str(caught.value.__cause__)


def test_an_error_that_cannot_be_sent_is_told_in_words() -> None:
    with pytest.raises(RuntimeError, match="Unpicklable"):
        list(run_tasks(raise_unpicklable, [0], 2))


def test_workers_are_other_processes_with_one_thread_each() -> None:
    replies = dict(run_tasks(threads, range(2), 2))
    assert {setting for setting, _ in replies.values()} == {"1"}
    assert os.getpid() not in {pid for _, pid in replies.values()}


def test_a_worker_that_dies_is_an_error_that_says_so() -> None:
    with pytest.raises(CellError, match="task 1 was killed by SIGKILL"):
        list(run_tasks(die, range(4), 2))


def test_a_worker_that_is_leaving_already_leaves_in_silence(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(CellError, match="task 0 was killed by SIGTERM"):
        list(run_tasks(be_told_to_end_twice, [0], 2))
    assert capfd.readouterr().err == ""


def interrupted_once_begun(folder: Path, tasks: int) -> Iterator[Path]:
    """So many tasks, and a keyboard interrupt once all of them have begun."""
    yield from [folder] * tasks
    while len(list(folder.glob("*-begun"))) < tasks:
        time.sleep(0.02)
    raise KeyboardInterrupt


def test_giving_up_early_cuts_off_what_is_under_way(tmp_path: Path) -> None:
    with closing(run_tasks(square, count(), 2)) as endless:
        assert len([next(endless) for _ in range(5)]) == 5
    results = run_tasks(leave_a_mark_at_the_end, interrupted_once_begun(tmp_path, 2), 3)
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert len(list(tmp_path.glob("*-left"))) == 2
    assert not [child for child in psutil.Process().children() if "spawn_main" in " ".join(child.cmdline())]


@pytest.mark.parametrize("workers", [0, -1])
def test_somebody_has_to_do_the_work(workers: int) -> None:
    with pytest.raises(ConfigError, match="at least one"):
        next(run_tasks(square, [1], workers))


RAY = """
import psutil
from policy.rollouts import run_tasks
from robotcell.errors import ConfigError
from tests.policy.test_rollouts import refuse_three

results = []
try:
    results.extend(run_tasks(refuse_three, [7, 5, 3], 1, "local"))
except ConfigError as error:
    assert "task 2 failed" in str(error.__cause__), error.__cause__
assert results == [(0, 7), (1, 5)], results
psutil.wait_procs(psutil.Process().children(recursive=True), timeout=10)
assert not psutil.Process().children(recursive=True)
print("done")
"""


def test_ray_gives_the_same_results() -> None:
    pytest.importorskip("ray")
    completed = subprocess.run([sys.executable, "-c", RAY], capture_output=True, text=True, check=False)
    assert completed.stdout.endswith("done\n"), completed.stderr


def test_a_ray_address_at_which_nothing_listens_is_refused_at_once() -> None:
    pytest.importorskip("ray")
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        port = server.getsockname()[1]
    for address in (f"127.0.0.1:{port}", f"ray://127.0.0.1:{port}"):
        with pytest.raises(ConfigError, match="no Ray cluster answers"):
            next(run_tasks(square, [1], 1, address))
