"""The doctor's look at this computer: the vendors' libraries, and the right to open the camera."""

from __future__ import annotations

import platform
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING

from robotcell.findings import Finding, Grade

if TYPE_CHECKING:
    from collections.abc import Iterator

_SDKS = ("ur_rtde", "pymodbus", "pyrealsense2")
_UDEV_FOLDERS = ("/etc/udev/rules.d", "/run/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")
# Vendor and product of the D415 on USB.
_UDEV_IDS = ("8086", "0ad3")


def examine_computer(camera_source: str) -> Iterator[Finding]:
    """What is installed; `camera_source` says whether a camera on USB is wanted."""
    yield Finding("computer", "python", f"{platform.python_version()} on {platform.platform(terse=True)}")
    for name in _SDKS:
        try:
            yield Finding("computer", name, version(name))
        except PackageNotFoundError:
            yield Finding("computer", name, "missing", Grade.WRONG, "pip install 'robotcell[hardware]'")
    if camera_source == "usb" and sys.platform == "linux":
        yield _examine_udev()


def _examine_udev() -> Finding:
    for folder in _UDEV_FOLDERS:
        for path in sorted(Path(folder).glob("*.rules")):
            text = path.read_text(encoding="utf-8", errors="replace").lower()
            if all(number in text for number in _UDEV_IDS):
                return Finding("computer", "udev rule", str(path))
    cure = (
        "install the camera's udev rule as docs/how-to/install-hardware.md says; without it only root can open the "
        "camera"
    )
    return Finding("computer", "udev rule", "missing", Grade.WRONG, cure)
