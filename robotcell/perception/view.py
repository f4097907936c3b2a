"""One look at the table: a frame, its heightmap, and the objects that it shows."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.surroundings import bin_box
from robotcell.errors import CalibrationError, CellError, DeviceFault
from robotcell.geometry.bodies import blocks_view
from robotcell.perception.arm_mask import arm_mask
from robotcell.perception.calibrated_camera import CalibratedCamera
from robotcell.perception.clearance_map import ClearanceMap, build_clearance_map
from robotcell.perception.heightmap import Heightmap, build_heightmap
from robotcell.perception.segmentation import Segmentation, segment
from robotcell.perception.tags import check_tags

if TYPE_CHECKING:
    from collections.abc import Iterator

    from robotcell.config import CellConfig, Workspace
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import Devices, RgbdFrame


@dataclass(frozen=True)
class View:
    """One look at the table.

    Attributes:
        frame: as the camera delivered it.
        camera: that took it, as its calibration has it.
        heightmap: built from both.
        segmentation: of the heightmap.
        clearance: up to which height something may stand, wherever the camera looks.
    """

    frame: RgbdFrame
    camera: CalibratedCamera
    heightmap: Heightmap
    segmentation: Segmentation
    clearance: ClearanceMap


def look(devices: Devices, config: CellConfig, workspace: Workspace | None = None) -> View:
    """Read the camera and see what is on the table.

    Args:
        devices: connected.
        config: of the cell.
        workspace: the map to build: rectangle and resolution; that of the cell unless given.

    Raises:
        ConnectionLost, DeviceFault: the camera delivers nothing, or a stale or sparse frame.
        CalibrationError: as `see`.
    """
    if view_blocked(devices, config, workspace):
        raise DeviceFault(
            "the arm stands between the camera and the workspace: move it to the home pose, then look", device="arm"
        )
    return see(fresh_frame(devices, config), config, devices.arm.state().q, workspace)


def view_blocked(devices: Devices, config: CellConfig, workspace: Workspace | None = None, load_m: float = 0.0) -> bool:
    """Whether the arm, or a load, stands between the camera and the workspace, or the load above it.

    Args:
        devices: connected.
        config: of the cell.
        workspace: rectangle of the table; that of the cell unless given.
        load_m: how far a load reaches from the tcp to any side; 0 without one.

    Raises:
        ConnectionLost: the arm cannot be asked.
    """
    workspace, eye = workspace or config.workspace, CalibratedCamera.of(config.camera).position
    state, table = devices.arm.state(), config.table.height_m
    q, (x, y, _) = state.q, state.T_base_tcp[:3, 3]
    inside = all(low - load_m < v < high + load_m for v, (low, high) in ((x, workspace.x), (y, workspace.y)))
    if load_m > 0 and inside:
        # It hides where it was taken from less than it is seen there itself.
        return True
    return blocks_view(q, eye, workspace.x, workspace.y, table, load_m)


def fresh_frame(devices: Devices, config: CellConfig) -> RgbdFrame:
    """A frame of the camera.

    Raises:
        ConnectionLost, DeviceFault: there is none, or it is older than `limits.frame_age_s`.
    """
    frame = devices.camera.read()
    check_age(frame, devices.clock.now(), config)
    return frame


def check_age(frame: RgbdFrame, now: float, config: CellConfig) -> None:
    """Raise DeviceFault for a frame that is too old at `now` [s] on the cell's clock."""
    age = now - frame.t
    if age > config.limits.frame_age_s:
        raise DeviceFault(
            f"frame {frame.number} is {age:.2f} s old (limit {config.limits.frame_age_s} s): check the camera",
            device="camera",
        )


def see(frame: RgbdFrame, config: CellConfig, q: Array, workspace: Workspace | None = None) -> View:
    """What a frame shows of the table, if it is fit to act on. Touches no device, and depends on nothing else.

    Args:
        frame: with the workspace in free view.
        config: of the cell.
        q: joint angles (6,) [rad] at which it was taken.
        workspace: the map to build: rectangle and resolution; that of the cell unless given.

    Raises:
        DeviceFault: too little of the workspace is seen.
        CalibrationError: the table is not where the configuration has it, a fixed tag not where it was, or the
            calibration is of another resolution.
    """
    view, problems = examine(frame, config, q, workspace or config.workspace)
    if problems:
        raise problems[0]
    return view


def examine(frame: RgbdFrame, config: CellConfig, q: Array, workspace: Workspace) -> tuple[View, list[CellError]]:
    """What a frame shows, and everything that makes it unfit to act on; the arguments are those of `see`.

    Raises:
        CalibrationError: the calibration is of another resolution.
    """
    view, problems = view_of(frame, config, workspace, q), list[CellError]()
    try:
        if config.camera.measured is not None:
            check_tags(frame.color, config.camera.measured.tags)
    except CalibrationError as error:
        problems.append(error)
    problems += _coverage_problems(view.heightmap, config.limits.min_coverage)
    problems += _table_problems(view.heightmap, config)
    return view, problems


def view_of(frame: RgbdFrame, config: CellConfig, workspace: Workspace, q: Array | None = None) -> View:
    """What a frame shows, of now or of a recorded look, on the map of a workspace; nothing is checked.

    Args:
        frame: with the workspace in free view.
        config: of the cell.
        workspace: the map to build.
        q: joint angles (6,) [rad] at which it was taken; None for an arm that is in no picture.
    """
    camera = CalibratedCamera.of(config.camera)
    arm = None if q is None else arm_mask(q, camera, frame.intrinsics)
    without_arm = frame if arm is None else replace(frame, depth_m=np.where(arm, np.float32(0), frame.depth_m))
    heightmap = build_heightmap(without_arm, camera, workspace, config.table.height_m)
    clearance = build_clearance_map(frame, camera, config.table.height_m, (bin_box(config),), arm)
    return View(frame, camera, heightmap, segment(heightmap), clearance)


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
