"""Checks a calibration on the table: what the camera says of heights and places, against what the arm finds there.

The only figures that include everything: camera, arm, depth image and the calibration between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.config.fingers import closed_width
from robotcell.errors import CalibrationError, ConfigError
from robotcell.geometry.ur5e import inverse
from robotcell.motion.executor import Ending
from robotcell.motion.path_check import check_path
from robotcell.motion.plan import Grip, LinearMove, MotionPlan, Step, joint_move
from robotcell.motion.tool import flange_pose, tool_down
from robotcell.perception.heightmap import Heightmap, TablePlane, build_heightmap

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.geometry.transforms import Array

# The tips stand so high over a spot that is not touched: a gap that a rule or a gauge block measures.
HOVER_M = 0.010
# Their mean has a third of the depth noise.
_FRAMES = 9
# A spot is bare table when everything this far around it is seen and lies within this of the plane.
_BARE_RADIUS_M = 0.050
_BARE_BAND_M = 0.008
# The height of a spot is the mean over this much of the table: less than the finger tips, more than the noise.
_SPOT_RADIUS_M = 0.008
# The guarded descent: slow, from just above, ending at a force that a UR5e's own sensor can tell from its noise (3.5 N
# by its data sheet), and at the latest so far below where the camera has the table.
_TOUCH_FROM_M = 0.020
_TOUCH_SPEED_M_S = 0.010
_TOUCH_ACCELERATION_M_S2 = 0.20
_TOUCH_FORCE_N = 8.0
_TOUCH_BELOW_M = 0.012
_LIFT_SPEED_M_S = 0.040
# What picking needs: the fingers go to within 3 mm of the table, and a block is 20 mm wide and more.
MAX_HEIGHT_M = 0.003
MAX_SPREAD_M = 0.003


@dataclass(frozen=True)
class Touch:
    """One spot of the table.

    Attributes:
        place: (3,) where the camera has it, base frame [m].
        touched_m: height at which the finger tips met it, base frame; None where they only hovered.
    """

    place: Array
    touched_m: float | None = None

    @property
    def difference_m(self) -> float | None:
        """The camera's height minus the arm's [m]."""
        return None if self.touched_m is None else float(self.place[2]) - self.touched_m


@dataclass(frozen=True)
class Verification:
    """What was found.

    Attributes:
        table: the plane of the table in the heightmap, relative to the configured height.
        touches: the spots.
    """

    table: TablePlane
    touches: tuple[Touch, ...]

    @property
    def differences_m(self) -> Array:
        """(n,) the camera's heights minus the arm's, of the spots that were touched."""
        return np.array([t.difference_m for t in self.touches if t.difference_m is not None])

    def problems(self, config: CellConfig) -> list[str]:
        """What is too far off to pick with; empty if nothing is."""
        found = []
        limits, table, off = config.limits, self.table, self.differences_m
        if table.tilt_rad > limits.max_tilt_rad:
            found.append(
                f"the table appears tilted by {np.degrees(table.tilt_rad):.2f} degrees "
                f"(limit {np.degrees(limits.max_tilt_rad):.2f})"
            )
        if abs(table.offset_m) > limits.max_table_offset_m:
            found.append(
                f"the table appears {1000 * table.offset_m:+.1f} mm off "
                f"(limit {1000 * limits.max_table_offset_m:.1f}); is table.height_m right?"
            )
        if len(off) and abs(np.median(off)) > MAX_HEIGHT_M:
            found.append(
                f"the camera sees the table {1000 * np.median(off):+.1f} mm from where the arm finds it "
                f"(limit {1000 * MAX_HEIGHT_M:.1f})"
            )
        if len(off) and np.ptp(off) > 2 * MAX_SPREAD_M:
            found.append(
                f"camera and arm differ by {1000 * off.min():+.1f} to {1000 * off.max():+.1f} mm over the table "
                f"(limit {2000 * MAX_SPREAD_M:.1f} mm between them): its rotation is off"
            )
        return found


def verify(
    cell: Cell,
    count: int,
    *,
    touch: bool,
    consent: Callable[[], bool],
    hovering: Callable[[int, int, Array], None],
) -> Verification:
    """Look at the table from home, go to spots of it one after the other, and go home again.

    Args:
        cell: open, with nothing in its gripper.
        count: how many spots; fewer where the bare table has no room for them.
        touch: feel for the table at each spot instead of hovering over it.
        consent: asked before the arm moves; nothing moves if it says no.
        hovering: called while the tips stand `HOVER_M` over a spot, with its number from 1, the number of spots, and
            the spot (3,) where the camera has it, base frame [m].

    Raises:
        ConfigError: consent was not given.
        CalibrationError: the table is not where it should be, no spot of it is bare, or the arm does not meet it.
        UnsafeMotion, GuardTripped, DeviceFault, ConnectionLost: as path check, guard and devices do.
    """
    if not consent():
        raise ConfigError("nothing was moved")
    cell.home()
    table, spots = choose_spots(cell, count)
    touches = []
    for number, spot in enumerate(spots, 1):
        if touch:
            touches.append(touch_table(cell, spot))
        else:
            go_above(cell, spot, HOVER_M)
            hovering(number, len(spots), spot)
            touches.append(Touch(spot))
    cell.home()
    return Verification(table, tuple(touches))


def choose_spots(cell: Cell, count: int) -> tuple[TablePlane, list[Array]]:
    """Look at the table from home, and choose bare spots of it, far from each other.

    Returns:
        The table's plane, and the places (3,) [m] of the spots in the base frame as the camera has them.

    Raises:
        CalibrationError, DeviceFault: as `robotcell.perception.view.look`; or no spot of the table is bare.
    """
    config, view = cell.config, cell.look()
    table = view.heightmap.table
    maps = [
        build_heightmap(cell.camera.read(), view.camera, config.workspace, config.table.height_m)
        for _ in range(_FRAMES)
    ]
    stack = np.ma.masked_invalid(np.stack([m.closed_m for m in maps]))
    heights = stack.mean(axis=0).filled(np.nan)
    bare = _bare(heights, maps[0])
    spots: list[Array] = []
    distance = cv2.distanceTransform(np.pad(bare, 1).astype(np.uint8), cv2.DIST_L2, 5)[1:-1, 1:-1].astype(np.float64)
    rows, cols = np.indices(bare.shape)
    while len(spots) < count and bare.any():
        # The first spot is the most open one, the next ones are the farthest from those before.
        row, col = np.unravel_index(int(np.where(bare, distance, -1).argmax()), bare.shape)
        x, y = config.workspace.position(int(row), int(col))
        away = np.hypot(rows - row, cols - col) * config.workspace.resolution_m
        z = float(np.nanmean(heights[away < _SPOT_RADIUS_M])) + config.table.height_m
        distance = away if not spots else np.minimum(distance, away)
        bare &= away > _BARE_RADIUS_M
        spots.append(np.array([x, y, z]))
    if table is None or not spots:
        raise CalibrationError("no spot of the table is bare: clear a part of the workspace, then verify again")
    return table, spots


def go_above(cell: Cell, spot: Array, height_m: float) -> None:
    """Close the fingers and stand over a spot, the tips so high above where the camera has it.

    Raises:
        UnsafeMotion, GuardTripped, DeviceFault, ConnectionLost: as path check, guard and devices do.
    """
    config, q = cell.config, cell.arm.state().q
    high, low = (_tool_at(spot, h) for h in (max(config.motion.approach_m, height_m), height_m))
    T_up = cell.arm.state().T_base_tcp
    T_up[2, 3] = max(T_up[2, 3], high[2, 3])
    steps: list[Step] = [
        Grip("close", closed_width(config), config.gripper.force_n),
        LinearMove("up", T_up, config.motion.guarded_speed_m_s, config.motion.linear_acceleration_m_s2),
        joint_move("go above", _solve(high, config), config),
        LinearMove("hover", low, config.motion.guarded_speed_m_s, config.motion.linear_acceleration_m_s2),
    ]
    cell.executor.run(check_path(MotionPlan("hover", q, tuple(steps)), config))


def touch_table(cell: Cell, spot: Array) -> Touch:
    """Feel for the table at a spot with the closed fingers: slowly, guarded, and never far below it.

    Raises:
        CalibrationError: nothing is there.
        UnsafeMotion, GuardTripped, DeviceFault, ConnectionLost: as path check, guard and devices do.
    """
    go_above(cell, spot, _TOUCH_FROM_M)
    lowest_tip_m = float(spot[2]) - _TOUCH_BELOW_M - cell.config.table.height_m
    down = LinearMove(
        "feel for the table",
        _tool_at(spot, -_TOUCH_BELOW_M),
        _TOUCH_SPEED_M_S,
        _TOUCH_ACCELERATION_M_S2,
        contact_force_n=_TOUCH_FORCE_N,
    )
    plan = MotionPlan("touch", cell.arm.state().q, (down,))
    execution = cell.executor.run(check_path(plan, cell.config, lowest_tip_m=lowest_tip_m))
    met = cell.arm.state().T_base_tcp[2, 3]
    up = LinearMove("lift", _tool_at(spot, _TOUCH_FROM_M), _LIFT_SPEED_M_S, _TOUCH_ACCELERATION_M_S2)
    plan = MotionPlan("lift", cell.arm.state().q, (up,))
    cell.executor.run(check_path(plan, cell.config, lowest_tip_m=lowest_tip_m))
    if execution.ending is not Ending.CONTACT:
        raise CalibrationError(
            f"the arm met nothing down to {1000 * _TOUCH_BELOW_M:.0f} mm below where the camera sees the table at "
            f"x {spot[0]:.3f}, y {spot[1]:.3f} m: check table.height_m, then calibrate again"
        )
    return Touch(spot, float(met))


def _bare(heights: npt.NDArray[np.floating], heightmap: Heightmap) -> npt.NDArray[np.bool_]:
    """(H, W): flat table all around, and within the map."""
    resolution = heightmap.workspace.resolution_m
    level = np.nanmedian(heights[np.abs(heights - np.nanmedian(heights)) < _BARE_BAND_M])
    with np.errstate(invalid="ignore"):
        flat = (np.abs(heights - level) < _BARE_BAND_M).astype(np.uint8)
    size = 2 * int(np.ceil(_BARE_RADIUS_M / resolution)) + 1
    window = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.erode(flat, window, borderType=cv2.BORDER_CONSTANT, borderValue=0) > 0)


def _tool_at(spot: Array, height_m: float) -> Array:
    return tool_down(float(spot[0]), float(spot[1]), float(spot[2]) + height_m, 0.0)


def _solve(T_base_tcp: Array, config: CellConfig) -> Array:
    """Joint angles (6,) [rad] of a pose of the tool, nearest to home."""
    q = inverse(flange_pose(T_base_tcp), np.array(config.motion.home_q))
    if q is None:
        x, y, z = T_base_tcp[:3, 3]
        raise CalibrationError(f"the arm cannot reach x {x:.3f}, y {y:.3f}, z {z:.3f} m, which the camera sees")
    return q
