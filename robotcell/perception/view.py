"""One look at the table: a frame, its heightmap, and the objects that it shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from robotcell.errors import CalibrationError, CellError, DeviceFault
from robotcell.geometry.bodies import blocks_view
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.heightmap import Heightmap, build_heightmap
from robotcell.perception.segmentation import Segmentation, segment
from robotcell.perception.tags import check_tags

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.config import CellConfig, Workspace
    from robotcell.interfaces import Devices, RgbdFrame


@dataclass(frozen=True)
class View:
    """One look at the table.

    Attributes:
        frame: as the camera delivered it.
        camera: that took it, as its calibration has it.
        heightmap: built from both.
        segmentation: of the heightmap.
    """

    frame: RgbdFrame
    camera: CalibratedCamera
    heightmap: Heightmap
    segmentation: Segmentation


def look(devices: Devices, config: CellConfig, workspace: Workspace | None = None) -> View:
    """Read the camera and see what is on the table.

    Args:
        devices: connected.
        config: of the cell.
        workspace: the map to build: rectangle and resolution; that of the cell unless given.

    Raises:
        ConnectionLost, DeviceFault: the camera delivers nothing, or a stale or sparse frame.
        CalibrationError: the table is not where the configuration has it, a fixed tag not where it was, or the
            calibration is of another resolution.
    """
    workspace = workspace or config.workspace
    if arm_in_view(devices, config, workspace):
        raise DeviceFault(
            "the arm stands between the camera and the workspace: move it to the home pose, then look", device="arm"
        )
    view, problems = see(fresh_frame(devices, config), config, workspace)
    if problems:
        raise problems[0]
    return view


def arm_in_view(devices: Devices, config: CellConfig, workspace: Workspace) -> bool:
    """Whether the arm stands between the camera and a workspace.

    Raises:
        ConnectionLost: the arm cannot be asked.
    """
    eye = CalibratedCamera.of(config.camera).position
    return blocks_view(devices.arm.state().q, eye, workspace.x, workspace.y, config.table.height_m)


def fresh_frame(devices: Devices, config: CellConfig) -> RgbdFrame:
    """A frame of the camera.

    Raises:
        ConnectionLost, DeviceFault: there is none, or it is older than `limits.frame_age_s`.
    """
    frame, limit = devices.camera.read(), config.limits.frame_age_s
    age = devices.clock.now() - frame.t
    if age > limit:
        raise DeviceFault(
            f"frame {frame.number} is {age:.2f} s old (limit {limit} s): check the camera", device="camera"
        )
    return frame


def see(frame: RgbdFrame, config: CellConfig, workspace: Workspace) -> tuple[View, list[CellError]]:
    """What a frame shows, and everything that makes it unfit to act on.

    Raises:
        CalibrationError: the calibration is of another resolution.
    """
    camera, problems = CalibratedCamera.of(config.camera), list[CellError]()
    heightmap = build_heightmap(frame, camera, workspace, config.table.height_m)
    try:
        if config.camera.measured is not None:
            check_tags(frame.color, config.camera.measured.tags)
    except CalibrationError as error:
        problems.append(error)
    problems += _coverage_problems(heightmap, config.limits.min_coverage)
    problems += _table_problems(heightmap, config)
    return View(frame, camera, heightmap, segment(heightmap)), problems


def _coverage_problems(heightmap: Heightmap, min_coverage: float) -> Iterator[CellError]:
    # Without the gaps between pixels, which say something of the resolution and nothing of the view.
    coverage = float(np.isfinite(heightmap.closed_m).mean())
    if coverage < min_coverage:
        yield DeviceFault(
            f"the camera sees {coverage:.0%} of the workspace (limit {min_coverage:.0%}): check its view, its "
            f"lens and the light; cells finer than its pixels (here {1000 * heightmap.workspace.resolution_m:g} mm) "
            "stay empty too",
            device="camera",
        )


def _table_problems(heightmap: Heightmap, config: CellConfig) -> Iterator[CellError]:
    table, limits = heightmap.table, config.limits
    if table is None:
        yield CalibrationError("too little of the table is seen to tell where it is: clear a part of the workspace")
    elif table.tilt_rad > limits.max_tilt_rad or abs(table.offset_m) > limits.max_table_offset_m:
        yield CalibrationError(
            f"the table appears tilted by {np.degrees(table.tilt_rad):.2f} degrees and {1000 * table.offset_m:+.1f} mm "
            f"off (limits {np.degrees(limits.max_tilt_rad):.2f} degrees, {1000 * limits.max_table_offset_m:.1f} mm): "
            "check table.height_m and the camera's pose, calibrate again if it was moved"
        )
