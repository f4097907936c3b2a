"""The child process of the UR5e driver: the only place where ur_rtde runs. `python -m robotcell.drivers.ur5e.child`.

It leaves by `os._exit`: the destructors of ur_rtde can hang for ever. A timer of the kernel ends it when ur_rtde holds
it for too long, whatever holds the interpreter's lock. From the moment it is gone nobody kicks the controller's
watchdog, which then stops the arm.
"""

from __future__ import annotations

import os
import signal
import sys
from contextlib import suppress
from mmap import mmap
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, NoReturn

from robotcell.drivers.ur5e.messages import Answer, Close, StartJoints, StartLinear, StartPath
from robotcell.drivers.ur5e.session import Session
from robotcell.errors import ConnectionLost

if TYPE_CHECKING:
    from robotcell.drivers.ur5e.messages import Request

_TICK_S = 0.004
# How long ur_rtde may hold this process: while it connects and uploads its program, and afterwards.
_SETUP_LASTS_S = 7.5
_HANG_S = 2.0


def main() -> NoReturn:
    """Entry point: numbers of the pipe's and the memory's file descriptors."""
    signal.setitimer(signal.ITIMER_REAL, _SETUP_LASTS_S)
    if sys.platform == "linux":
        # Ahead of everything else on the computer, where the system allows it: the watchdog does not wait.
        with suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(10))
    pipe, memory = Connection(int(sys.argv[1])), mmap(int(sys.argv[2]), 0)
    try:
        setup = pipe.recv()
        session = Session(setup, memory)
        pipe.send(Answer(session.take_control(setup) if setup.control else ""))
        _serve(session, pipe)
    except ConnectionLost as error:
        _leave(str(error))
    except (EOFError, OSError):
        _leave("the driver is gone")
    except BaseException as error:
        _leave(f"{type(error).__name__}: {error}")
    _leave("")


def _serve(session: Session, pipe: Connection) -> None:
    """Serve the driver until it closes or dies; ConnectionLost ends it too."""
    while True:
        signal.setitimer(signal.ITIMER_REAL, _HANG_S)
        try:
            request: Request | None = pipe.recv() if pipe.poll(_TICK_S) else None
        except (EOFError, OSError):
            request = Close()
        if isinstance(request, Close):
            session.end()
            return
        session.publish()
        if isinstance(request, (StartJoints, StartLinear, StartPath)):
            pipe.send(Answer(session.start(request)))
        session.supervise()


def _leave(reason: str) -> NoReturn:
    """End this process without running a destructor of ur_rtde; the driver reads the reason from the log."""
    print(reason, file=sys.stderr, flush=True)  # noqa: T201
    os._exit(1 if reason else 0)


if __name__ == "__main__":
    main()
