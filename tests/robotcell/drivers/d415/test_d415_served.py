"""The D415's driver and a served camera that is as noisy as a real one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.config import load_config
from robotcell.drivers.clock import WallClock
from robotcell.drivers.d415.camera import D415, D415Options
from sim_twin.wire.d415.stream import SERIAL
from tests.robotcell.drivers.served_cell import CAMERA_PORT, HOST

if TYPE_CHECKING:
    from sim_twin.wire.cell import ServedCell


def test_a_frame_shows_what_the_camera_sees_with_settled_exposure(served: ServedCell) -> None:
    mount = load_config().camera
    with D415(D415Options(source=f"twin://{HOST}:{CAMERA_PORT}"), mount, WallClock()) as camera:
        first = camera.read()
        later = [camera.read() for _ in range(5)][-1]
    assert served.ended == []
    assert first.color.mean() == pytest.approx(later.color.mean(), rel=0.02)
    assert first.serial == SERIAL
    T = mount.pose()
    assert np.median(first.depth_m[220:260, 300:340]) == pytest.approx(-T[2, 3] / T[2, 2], abs=0.06)
