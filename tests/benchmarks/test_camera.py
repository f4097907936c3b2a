"""What one frame of the twin's camera costs, whole and in parts: `pytest tests/benchmarks/test_camera.py
--benchmark-enable`. Targets: 45 ms at 640x480, 120 ms at 1280x720, on two cores."""

import numpy as np
import pytest

from robotcell.config import CameraMount
from sim_twin.d415.noise import degrade_color, degrade_depth
from sim_twin.d415.rays import RayCaster
from sim_twin.d415.renderer import MODES
from sim_twin.devices.camera import TwinCamera
from sim_twin.options import NoiseOptions, TwinOptions
from tests.sim_twin.boxes import table_with_blocks

RESOLUTIONS = pytest.mark.parametrize("resolution", sorted(MODES, reverse=True))


@pytest.fixture
def frame(resolution):
    with TwinCamera(table_with_blocks(30), CameraMount(resolution=resolution), TwinOptions(seed=1)) as camera:
        return camera.read()


@RESOLUTIONS
def test_read(benchmark, resolution):
    with TwinCamera(table_with_blocks(30), CameraMount(resolution=resolution), TwinOptions(seed=1)) as camera:
        frame = benchmark(camera.read)
    assert frame.depth_m.any()


@RESOLUTIONS
def test_cast(benchmark, resolution):
    world, mount = table_with_blocks(30), CameraMount(resolution=resolution)
    caster = RayCaster(world.visuals(), MODES[resolution], mount.pose())
    assert benchmark(caster.cast, world.visual_poses()).depth_m.any()


@RESOLUTIONS
def test_depth_noise(benchmark, frame):
    cos = np.full_like(frame.depth_m, 0.9)
    noisy = benchmark(degrade_depth, frame.depth_m, cos, frame.intrinsics, NoiseOptions(), seed=1, frame=1)
    assert noisy.any()


@RESOLUTIONS
def test_color_noise(benchmark, frame):
    noisy = benchmark(degrade_color, frame.color, NoiseOptions(), seed=1, frame=1, t=1.0, frames_since_start=99)
    assert noisy.any()
