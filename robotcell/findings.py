"""What the doctor and the preflight of a job find: the rows of their reports."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.errors import CellError, DeviceFault

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable


class Grade(enum.Enum):
    """How good a finding is."""

    OK = "ok"
    NOTE = "note"  # works, and could be better
    WRONG = "wrong"  # a job cannot run, or not safely


@dataclass(frozen=True)
class Finding:
    """One row of a report.

    Attributes:
        device: that it is about: arm, gripper, camera, calibration, table, bin, storage, computer.
        what: was looked at.
        value: that was found.
        grade: how good that is.
        cure: what to do where the grade is not OK.
        code: of the error (`robotcell.errors`) with which a job is refused where the grade is WRONG.
    """

    device: str
    what: str
    value: str
    grade: Grade = Grade.OK
    cure: str = ""
    code: str = DeviceFault.code


def collect(device: str, look: Callable[[], Iterable[Finding]]) -> list[Finding]:
    """What a look at a device finds, up to the error that ends it."""
    found: list[Finding] = []
    try:
        found.extend(look())
    except CellError as error:
        what = "further" if found else "reach"
        found.append(Finding(device, what, "failed", Grade.WRONG, str(error), error.code))
    return found
