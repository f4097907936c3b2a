from __future__ import annotations

import os
import subprocess
import sys
import termios
from pty import openpty

# Space, and Space again, as they come from a terminal; each time the job asks whether it is held.
CODE = """
import fcntl, os, termios, time
os.setsid()
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
from cli.keyboard import KeyboardHold
said = []
def say(words):
    said.append(words)
    print(words, flush=True)
with KeyboardHold(say) as hold:
    print("asked", hold(), flush=True)
    while not said:
        time.sleep(0.01)
    print("asked", hold(), flush=True)
    print("asked", hold(), flush=True)
"""


def test_space_holds_and_space_goes_on() -> None:
    ours, theirs = openpty()
    try:
        before = termios.tcgetattr(theirs)
        with subprocess.Popen([sys.executable, "-c", CODE], stdin=theirs, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            assert next(lines) == "asked False\n"
            os.write(ours, b"x ")
            assert next(lines).startswith("hold after this action")
            assert next(lines).startswith("held")
            os.write(ours, b" ")
            assert next(lines) == "going on\n"
            assert list(lines) == ["asked True\n", "asked False\n"]
        assert process.returncode == 0
        assert termios.tcgetattr(theirs) == before, "the terminal is as it was"
    finally:
        os.close(ours)
        os.close(theirs)


def test_without_a_terminal_nothing_is_held() -> None:
    code = "from cli.keyboard import KeyboardHold\nwith KeyboardHold(print) as hold:\n    print(hold())"
    done = subprocess.run(
        [sys.executable, "-c", code], stdin=subprocess.DEVNULL, capture_output=True, text=True, check=True
    )
    assert done.stdout == "False\n"
