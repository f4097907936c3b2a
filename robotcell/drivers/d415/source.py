"""Where the camera's frames come from, if not from USB: a plugged-in source, or a recorded file."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import TYPE_CHECKING, Any, Protocol

from robotcell.drivers.d415.realsense import sdk_errors, serial_number
from robotcell.errors import ConfigError, DeviceFault

if TYPE_CHECKING:
    from pathlib import Path


# In what librealsense says of a file that it cannot read.
_UNREADABLE = "Request to enable_device_from_file"


class CameraSource(Protocol):
    """Cameras that are not on USB. An entry point of the group `robotcell.camera_sources` is a function that opens one.

    It is called with the address and with the resolution that will be asked for, as "640x480", and raises
    ConnectionLost if nothing is there.
    """

    @property
    def context(self) -> Any:
        """The pyrealsense2 context in which the cameras are found."""
        ...

    def close(self) -> None:
        """End it. Called after the last stream has ended."""
        ...


def open_source(source: str, resolution: str) -> CameraSource:
    """Open the source of `NAME://ADDRESS`.

    Raises:
        ConfigError: no source has that name, or it cannot be imported.
        ConnectionLost: nothing is at the address.
    """
    name, _, address = source.partition("://")
    installed = {entry.name: entry for entry in entry_points(group="robotcell.camera_sources")}
    if name not in installed:
        raise ConfigError(
            f"camera: no source of frames is called {name!r}; installed: {', '.join(sorted(installed)) or 'none'}",
            device="camera",
        )
    try:
        opener = installed[name].load()
    except ImportError as error:
        raise ConfigError(
            f"camera: the source {name!r} cannot be imported ({error}); install its extra", device="camera"
        ) from error
    opened: CameraSource = opener(address, resolution)
    return opened


def open_recording(rs: Any, context: Any, config: Any, path: Path, serial: str | None) -> Any:
    """The device that a recorded file holds; `config` is told to play it.

    Args:
        rs: the module pyrealsense2.
        context: an rs.context.
        config: the rs.config that the streams will be started with.
        path: of the file.
        serial: of the camera that must have recorded it; None for any.

    Raises:
        ConfigError: there is no such file, or it is no whole recording.
        ConnectionLost: it cannot be played.
        DeviceFault: another camera has recorded it, or in another mode.
    """
    if not path.is_file():
        raise ConfigError(f"camera: {path}: no such file; make one with robotcell twin record", device="camera")
    with sdk_errors(f"opening {path}"):
        config.enable_device_from_file(str(path))
        try:
            device = config.resolve(rs.pipeline_wrapper(rs.pipeline(context))).get_device()
        except RuntimeError as error:
            if _UNREADABLE not in str(error):
                raise
            raise ConfigError(
                f"camera: {path} is no whole recording ({str(error).rpartition(': ')[2]}): it was cut off or damaged, "
                "or another generation of librealsense has written it; record it again (docs/how-to/recordings.md)",
                device="camera",
            ) from error
    if serial not in (None, serial_number(device)):
        raise DeviceFault(
            f"camera: {path} was recorded by {serial_number(device)}, and the option camera.serial asks for {serial}",
            device="camera",
        )
    return device
