from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from robotcell.cell import Cell
from robotcell.config import CellConfig
from robotcell.errors import ConfigError, ConnectionLost, DeviceFault
from robotcell.geometry.rg2 import range_with_tips
from robotcell.interfaces import Devices, GripperRange


@dataclass
class Device:
    """A device that fails to connect when told to, and notes what is asked of it."""

    failure: BaseException | None = None
    calls: list[str] = field(default_factory=list)

    def connect(self) -> None:
        self.calls.append("connect")
        if self.failure:
            raise self.failure

    def close(self) -> None:
        self.calls.append("close")

    def range(self) -> GripperRange:
        return range_with_tips(0.0)


def cell_of(*devices: Device) -> Cell:
    arm, gripper, camera = (cast("Any", device) for device in devices)
    return Cell(CellConfig(), Devices(arm, gripper, camera, cast("Any", None)))


def test_every_device_is_connected_and_closed() -> None:
    devices = Device(), Device(), Device()
    with cell_of(*devices):
        assert [device.calls for device in devices] == [["connect"]] * 3
    assert [device.calls for device in devices] == [["connect", "close"]] * 3


def test_one_attempt_shows_everything_that_is_wrong() -> None:
    devices = Device(ConnectionLost("no answer from 192.168.1.10")), Device(), Device(DeviceFault("USB 2 cable"))
    with pytest.raises(ConnectionLost) as caught, cell_of(*devices):
        pass
    assert "arm: no answer from 192.168.1.10" in str(caught.value)
    assert "camera: USB 2 cable" in str(caught.value)
    assert all(device.calls == ["connect", "close"] for device in devices)


def test_devices_that_are_there_but_refuse_are_a_fault() -> None:
    with pytest.raises(DeviceFault), cell_of(Device(DeviceFault("e-stop")), Device(DeviceFault("S1 pushed")), Device()):
        pass


@pytest.mark.parametrize("failure", [ConfigError("scene moon is unknown"), KeyboardInterrupt(), DeviceFault("e-stop")])
def test_a_single_failure_is_passed_on_and_leaves_nothing_open(failure: BaseException) -> None:
    devices = Device(failure), Device(), Device()
    with pytest.raises(type(failure)) as caught, cell_of(*devices):
        pass
    assert caught.value is failure
    assert all(device.calls[-1] == "close" for device in devices)
