"""A real cell is tested only where that is asked for, by somebody who can stop it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable

ROOT = Path(__file__).parents[2]
STANDING = "--i-stand-at-the-emergency-stop"
HARDWARE = ("-m", "hardware", "--cell-file", str(ROOT / "examples" / "hardware.toml"))


@pytest.fixture
def collect(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, str]]:
    """What pytest would run of the gripper's contract: its exit code and its words."""

    def run(*options: str) -> tuple[int, str]:
        tests = str(ROOT / "tests" / "contract" / "test_gripper.py")
        code = pytest.main([tests, "--collect-only", "-q", "-p", "no:cacheprovider", *options])
        return int(code), "".join(capsys.readouterr())

    return run


def test_nothing_moves_without_somebody_at_the_emergency_stop(collect: Callable[..., tuple[int, str]]) -> None:
    code, words = collect(*HARDWARE)
    assert code == pytest.ExitCode.USAGE_ERROR
    assert STANDING in words


def test_a_real_cell_is_off_unless_it_is_asked_for(collect: Callable[..., tuple[int, str]]) -> None:
    _, usual = collect(*HARDWARE[2:], STANDING)
    assert "test_stop_leaves_the_fingers_where_they_are[served]" in usual
    assert "[real" not in usual
    _, asked = collect(*HARDWARE, STANDING)
    assert "test_stop_leaves_the_fingers_where_they_are[real]" in asked
    assert "[served" not in asked
    assert "[twin" not in asked
