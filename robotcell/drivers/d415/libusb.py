"""libusb for SDKs of cameras that need it at import, whether a camera is on USB or not."""

from __future__ import annotations

import ctypes
import importlib
import sys

from robotcell.errors import ConfigError

_LIBUSB = "libusb-1.0.so.0"


def load_libusb(sdk: str, extra: str) -> None:
    """Load libusb for the whole process: that of the system, else that of the wheel `libusb-package`.

    Args:
        sdk: the module that needs it.
        extra: of robotcell, that brings the module and the wheel.

    Raises:
        ConfigError: there is none.
    """
    if sys.platform != "linux":
        return
    try:
        ctypes.CDLL(_LIBUSB, mode=ctypes.RTLD_GLOBAL)
        return
    except OSError:
        pass
    try:
        package = importlib.import_module("libusb_package")
        ctypes.CDLL(str(package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
    except (ImportError, OSError) as error:
        raise ConfigError(
            f"{sdk} needs {_LIBUSB}; neither the system nor the package libusb-package has it ({error}): "
            f"pip install 'robotcell[{extra}]'",
            device="camera",
        ) from error
