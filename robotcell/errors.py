"""The errors of the cell, told apart by what the operator does next.

Each message says what happened, where, and the next step. No library's own exception leaves a driver.
"""


class CellError(Exception):
    """Base of every error that the cell raises on purpose."""


class ConfigError(CellError, ValueError):
    """A file or an argument is wrong: correct it and start again."""


class ConnectionLost(CellError, ConnectionError):
    """A device cannot be reached, or no longer can: restore the link, then connect again."""


class DeviceFault(CellError, RuntimeError):
    """A device refuses to work (e-stop, protective stop, gripper fault): clear it at the device, then recover."""


class UnsafeMotion(CellError, ValueError):
    """A motion was refused before anything moved: change the target or the limits."""


class GuardTripped(CellError, RuntimeError):
    """A motion was stopped while it ran: look at the cell, then recover."""


class CalibrationError(CellError, ValueError):
    """The camera does not see the table where it should: calibrate again."""


class NoTarget(CellError, LookupError):
    """Nothing on the table fits the request: change the goal or put the object there."""
