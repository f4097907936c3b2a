"""The errors of the cell, told apart by what the operator does next.

Each message says what happened, where, and the next step. No library's own exception leaves a driver.
"""

from __future__ import annotations

from typing import ClassVar, Literal, TypeAlias

DeviceName: TypeAlias = Literal["arm", "gripper", "camera"]


class CellError(Exception):
    """Base of every error that the cell raises on purpose.

    Args:
        message: what happened, where, and the next step.
        device: the device that it is about; None where it is about none, or about several.

    Attributes:
        code: names the class in reports that programs read.
    """

    code: ClassVar[str] = "cell"

    def __init__(self, message: str = "", *, device: DeviceName | None = None) -> None:
        super().__init__(message)
        self.device = device


class ConfigError(CellError, ValueError):
    """A file or an argument is wrong: correct it and start again."""

    code = "config"


class ConnectionLost(CellError, ConnectionError):
    """A device cannot be reached, or no longer can: restore the link, then connect again."""

    code = "connection-lost"


class DeviceFault(CellError, RuntimeError):
    """A device refuses to work (e-stop, protective stop, gripper fault): clear it at the device, then recover."""

    code = "device-fault"


class UnsafeMotion(CellError, ValueError):
    """A motion was refused before anything moved: change the target or the limits."""

    code = "unsafe-motion"


class GuardTripped(CellError, RuntimeError):
    """A motion was stopped while it ran: look at the cell, then recover."""

    code = "guard-tripped"


class CalibrationError(CellError, ValueError):
    """The camera does not see the table where it should: calibrate again."""

    code = "calibration"


class NoTarget(CellError, LookupError):
    """Nothing on the table fits the request: change the goal or put the object there."""

    code = "no-target"


class StorageError(CellError, OSError):
    """A file could not be written: make room or correct its folder, then start again."""

    code = "storage"
