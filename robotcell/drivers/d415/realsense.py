"""What the D415 driver needs of librealsense: the module itself, its errors in the cell's words, and the device."""

from __future__ import annotations

import functools
import importlib
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from robotcell.drivers.d415.libusb import load_libusb
from robotcell.errors import CellError, ConfigError, ConnectionLost, DeviceFault

if TYPE_CHECKING:
    from collections.abc import Iterator

USB_ADVICE = (
    "check that the cable sits firmly in a USB 3 port of the machine itself (no hub, at most 2 m, the cable that came "
    "with the camera), and plug it in again"
)
_ABSENT_ADVICE = (
    "check the cable, that `lsusb` lists Intel RealSense, and that its udev rules are installed "
    "(docs/how-to/install-hardware.md)"
)


@functools.cache
def load_pyrealsense2() -> Any:
    """The module pyrealsense2.

    Raises:
        ConfigError: it or libusb is not installed.
    """
    load_libusb("pyrealsense2", "hardware")
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        raise ConfigError(
            f"the camera's library cannot be loaded ({error}): pip install 'robotcell[hardware]'", device="camera"
        ) from error


@contextmanager
def sdk_errors(doing: str) -> Iterator[None]:
    """Turn what librealsense raises into the cell's errors.

    Args:
        doing: what was being done, for the message.

    Raises:
        DeviceFault: the device is in use, or has no such mode.
        ConnectionLost: anything else.
    """
    try:
        yield
    except CellError:
        raise
    except RuntimeError as error:
        text = str(error)
        if "busy" in text.lower() or "is streaming" in text:
            raise DeviceFault(
                f"camera: {doing} failed ({text}): another program uses the camera; close it (a viewer, another job), "
                "then connect again",
                device="camera",
            ) from error
        if "resolve requests" in text:
            raise DeviceFault(
                f"camera: {doing} failed ({text}): the camera does not offer this mode. Set camera.resolution to one "
                f"that it has; where it should have it, {USB_ADVICE}",
                device="camera",
            ) from error
        raise ConnectionLost(f"camera: {doing} failed ({text}): {USB_ADVICE}", device="camera") from error


def find_device(context: Any, serial: str | None) -> Any:
    """The camera of a context.

    Args:
        context: an rs.context.
        serial: of the camera; None if there is only one.

    Raises:
        ConnectionLost: it is not there.
        DeviceFault: there are several, and no serial says which.
    """
    with sdk_errors("looking for cameras"):
        found = {serial_number(device): device for device in context.query_devices()}
    if not found:
        raise ConnectionLost(f"camera: no RealSense camera is connected; {_ABSENT_ADVICE}", device="camera")
    if serial is None and len(found) > 1:
        raise DeviceFault(
            f"camera: {len(found)} cameras are connected ({', '.join(sorted(found))}); say which one is the cell's by "
            "the option camera.serial",
            device="camera",
        )
    if serial is None:
        return next(iter(found.values()))
    if serial not in found:
        raise ConnectionLost(
            f"camera: {serial} is not connected, only {', '.join(sorted(found))}; plug in the right camera, or correct "
            "the option camera.serial",
            device="camera",
        )
    return found[serial]


def serial_number(device: Any) -> str:
    """The serial number of a device.

    Raises:
        ConnectionLost: it does not answer.
    """
    with sdk_errors("asking the camera for its serial number"):
        return str(device.get_info(load_pyrealsense2().camera_info.serial_number))


def describe_device(device: Any) -> str:
    """Name, serial number, firmware and USB link of a device, as far as it tells them.

    Raises:
        ConnectionLost: it does not answer.
    """
    info = load_pyrealsense2().camera_info
    parts = (
        ("", info.name),
        ("serial ", info.serial_number),
        ("firmware ", info.firmware_version),
        ("USB ", info.usb_type_descriptor),
    )
    with sdk_errors("asking the camera what it is"):
        return ", ".join(word + device.get_info(key) for word, key in parts if device.supports(key))


def check_usb(device: Any) -> None:
    """Refuse a camera on a USB 2 link, which cannot carry both streams.

    Raises:
        DeviceFault: it is.
    """
    rs = load_pyrealsense2()
    with sdk_errors("asking the camera for its USB link"):
        if not device.supports(rs.camera_info.usb_type_descriptor):
            return
        usb = device.get_info(rs.camera_info.usb_type_descriptor)
    if usb.startswith(("1", "2")):
        raise DeviceFault(
            f"camera: it is connected by USB {usb}, which is too slow for depth and colour; {USB_ADVICE}",
            device="camera",
        )
