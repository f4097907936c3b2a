"""A cell: its three devices, its clock and its configuration."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from robotcell.config.schema import CellConfig, find_backend
from robotcell.errors import ConnectionLost, DeviceFault, GuardTripped

if TYPE_CHECKING:
    from types import TracebackType

    from robotcell.interfaces import Arm, Camera, Clock, Gripper


class Latch:
    """Remembers a safety violation until an operator clears it. Every executor of a cell shares it."""

    def __init__(self) -> None:
        self._violation: str | None = None

    @property
    def violation(self) -> str | None:
        """What tripped it, or None."""
        return self._violation

    def trip(self, what: str) -> None:
        """Latch a violation; the first one stands."""
        self._violation = self._violation or what

    def clear(self) -> None:
        """Forget the violation. Only ever called because an operator asked for it."""
        self._violation = None

    def check(self) -> None:
        """Raise GuardTripped if a violation is latched."""
        if self._violation:
            raise GuardTripped(f"nothing moves after a safety stop ({self._violation}); look at the cell, then recover")


@dataclass(frozen=True)
class Cell:
    """The devices behind the interfaces. As a context manager it connects them all and closes them all."""

    config: CellConfig
    arm: Arm
    gripper: Gripper
    camera: Camera
    clock: Clock
    latch: Latch = field(default_factory=Latch)

    def __enter__(self) -> Cell:
        """Connect every device, so that one attempt shows everything that is wrong.

        Raises:
            ConnectionLost, DeviceFault: the failure of the one device that failed, or all of them together
                (as DeviceFault if every device could be reached).
            ConfigError: a backend finds its own settings wrong, at the first device.
        """
        failures: list[tuple[str, ConnectionLost | DeviceFault]] = []
        try:
            for name, device in (("arm", self.arm), ("gripper", self.gripper), ("camera", self.camera)):
                try:
                    device.connect()
                except (ConnectionLost, DeviceFault) as error:
                    failures.append((name, error))
        except BaseException:
            self.close()
            raise
        if failures:
            self.close()
            if len(failures) == 1:
                raise failures[0][1]
            kind = ConnectionLost if any(isinstance(e, ConnectionLost) for _, e in failures) else DeviceFault
            raise kind("\n  ".join(["the cell cannot be opened:", *(f"{name}: {error}" for name, error in failures)]))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close every device; idempotent."""
        self.camera.close()
        self.gripper.close()
        self.arm.close()


def open_cell(config: CellConfig) -> Cell:
    """The cell of a configuration, its devices not yet connected: use it in a `with` statement.

    Raises:
        ConfigError: its backend is not installed.
    """
    return find_backend(config.backend.name).open(config)
