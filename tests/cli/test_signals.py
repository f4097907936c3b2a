from __future__ import annotations

import signal
import subprocess
import sys

import pytest

# What a command does that is told to end: it stops the arm, which takes a moment.
CODE = """
import os, signal, sys, time
from cli.signals import end_cleanly_on_signals
end_cleanly_on_signals()
try:
    os.kill(os.getpid(), signal.{name})
    time.sleep(60)
except (KeyboardInterrupt, SystemExit) as ended:
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGINT):
        os.kill(os.getpid(), number)
    time.sleep(0.05)
    print("the arm stands", type(ended).__name__, getattr(ended, "code", None))
"""


@pytest.mark.parametrize(
    ("name", "ended"),
    [("SIGINT", "KeyboardInterrupt None"), ("SIGTERM", "SystemExit 143"), ("SIGHUP", "SystemExit 129")],
)
def test_no_further_signal_keeps_a_command_from_stopping_the_arm(name: str, ended: str) -> None:
    assert signal.Signals[name]
    done = subprocess.run(
        [sys.executable, "-c", CODE.format(name=name)], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.stdout == f"the arm stands {ended}\n", done.stderr
