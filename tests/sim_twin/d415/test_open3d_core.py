import ctypes
import subprocess
import sys

import pytest

from robotcell.errors import ConfigError
from sim_twin.d415.open3d_core import load_open3d


def run(code):
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip()


def test_only_what_casts_rays_is_imported():
    code = (
        "import sys; from sim_twin.d415.open3d_core import load_open3d; load_open3d(); "
        "print([m for m in ('dash', 'plotly', 'matplotlib', 'open3d') if m in sys.modules])"
    )
    assert run(code) == "[]"


@pytest.mark.parametrize("first", ["load_open3d(); import open3d", "import open3d; load_open3d()"])
def test_the_whole_of_open3d_can_be_imported_before_or_after(first):
    code = (
        "from sim_twin.d415.open3d_core import load_open3d; from robotcell.drivers.d415.libusb import load_libusb; "
        f"load_libusb('open3d', 'twin'); {first}; "
        "print(load_open3d().t.geometry.RaycastingScene is open3d.t.geometry.RaycastingScene)"
    )
    assert run(code) == "True"


def test_open3d_loads_with_the_libusb_of_the_wheel(monkeypatch):
    loaded = []

    def without_system_libusb(name, mode=ctypes.DEFAULT_MODE):
        if name == "libusb-1.0.so.0":
            raise OSError("no such file")
        loaded.append((name, mode))
        return real(name, mode)

    real = ctypes.CDLL
    monkeypatch.setattr(ctypes, "CDLL", without_system_libusb)
    monkeypatch.setattr(sys, "platform", "linux")
    assert hasattr(load_open3d.__wrapped__().t.geometry, "RaycastingScene")
    name, mode = loaded[0]
    assert "libusb_package" in name
    assert mode == ctypes.RTLD_GLOBAL


def test_without_any_libusb_the_message_says_what_to_install(monkeypatch):
    def no_library(name, mode):
        raise OSError("no such file")

    monkeypatch.setattr(ctypes, "CDLL", no_library)
    monkeypatch.setattr(sys, "platform", "linux")
    with pytest.raises(ConfigError, match=r"libusb-1\.0.*robotcell\[twin\]"):
        load_open3d.__wrapped__()


def test_without_open3d_the_message_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    monkeypatch.delitem(sys.modules, "open3d.pybind", raising=False)
    with pytest.raises(ConfigError, match=r"open3d.*robotcell\[twin\]"):
        load_open3d.__wrapped__()
