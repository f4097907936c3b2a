"""Loads of open3d what casts rays: its compiled part, without its visualizer.

`import open3d` also imports dash, plotly and what they need, which takes longer than all else that a pick needs.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import sys
from importlib.machinery import EXTENSION_SUFFIXES, ExtensionFileLoader
from pathlib import Path
from typing import Any

from robotcell.drivers.d415.libusb import load_libusb
from robotcell.errors import ConfigError

_PACKAGE = "open3d"
_COMPILED = "open3d.pybind"


@functools.cache
def load_open3d() -> Any:
    """What has open3d's `core` and `t`: its compiled part, or all of it where that is elsewhere than in open3d 0.20.

    A later `import open3d` finds the same part and completes it. open3d needs libusb at import even where no camera is
    used. Where the system has none, the one in the `libusb-package` wheel is loaded for the whole process.

    Raises:
        ConfigError: open3d or libusb is not installed.
    """
    load_libusb(_PACKAGE, "twin")
    try:
        return sys.modules.get(_COMPILED) or _compiled() or importlib.import_module(_PACKAGE)
    except ImportError as error:
        raise ConfigError(
            f"the twin's camera cannot load open3d ({error}); install the twin: pip install 'robotcell[twin]'"
        ) from error


def _compiled() -> Any:
    """The compiled part; None where the package has none of that name, or is not installed."""
    package = importlib.util.find_spec(_PACKAGE)
    folders = package.submodule_search_locations if package else None
    paths = [Path(folder) / f"pybind{suffix}" for folder in folders or () for suffix in EXTENSION_SUFFIXES]
    path = next((path for path in paths if path.is_file()), None)
    if path is None:
        return None
    loader = ExtensionFileLoader(_COMPILED, str(path))
    spec = importlib.util.spec_from_file_location(_COMPILED, path, loader=loader)
    if spec is None:
        return None
    module = importlib.util.module_from_spec(spec)
    sys.modules[_COMPILED] = module
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[_COMPILED]
        raise
    return module
