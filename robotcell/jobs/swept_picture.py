"""The page of a plan from above: what arm, gripper and load sweep, and how near they come to things."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.geometry import bodies, rg2, ur5e
from robotcell.motion.clearance import FAR_M, densified, smallest_gaps
from robotcell.motion.path_check import tools
from robotcell.motion.plan import JointMove, LinearMove
from robotcell.perception.clearance_map import RESOLUTION_M

if TYPE_CHECKING:
    from robotcell.geometry.transforms import Array
    from robotcell.motion.clearance import Obstruction, Tool
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.clearance_map import ClearanceMap

_Picture = npt.NDArray[np.uint8]

# Heights from the table to this one span the grey scale.
_SCALE_M = 0.40
_UNSEEN = (60, 20, 70)
_WHITE, _BLACK, _BLOCKED = (255, 255, 255), (0, 0, 0), (255, 40, 40)
# The base and the turning shoulder stay where they are.
_MOVES = bodies.SPHERES.group >= 2


def draw_plan(plan: CheckedPlan, seen: ClearanceMap, height_px: int) -> _Picture:
    """A picture (`height_px`, W, 3) RGB from above, base x up and base y to the left.

    The outline of what each motion sweeps is green where it keeps 80 mm or more from everything, over yellow to red
    where it keeps the least that is allowed; the numbers stand where the motions end.
    """
    panel = _Panel(seen, height_px)
    steps = zip(plan.plan.steps, tools(plan.plan), plan.joint_paths, strict=True)
    moves = [(tool, path) for step, tool, path in steps if isinstance(step, JointMove | LinearMove)]
    for tool, path in moves:
        dense = densified(path)
        share = float(smallest_gaps(dense, tool, seen).min()) / FAR_M
        panel.outline(dense, tool, _traffic_light(share))
    for number, (_, path) in enumerate(moves, start=1):
        x, y = (ur5e.forward(path[-1]) @ rg2.T_FLANGE_TCP)[:2, 3]
        panel.text(str(number), x, y)
    panel.caption("outlines: green 80 mm clear, red at the limit")
    return panel.image


def draw_obstruction(obstruction: Obstruction, q: Array, seen: ClearanceMap, height_px: int) -> _Picture:
    """The picture of a plan that was refused: what is in the way, and the arm (6,) [rad] where it would meet it."""
    panel = _Panel(seen, height_px)
    panel.outline(q[None], None, _BLOCKED)
    panel.cross(obstruction.x, obstruction.y)
    panel.caption(f"in the way: {obstruction.height_m:.2f} m high, of the {obstruction.body}")
    return panel.image


class _Panel:
    """The map of clearance as a picture, and drawing on it in metres of the base frame."""

    def __init__(self, seen: ClearanceMap, height_px: int) -> None:
        grey = (40 + 200 * np.clip(seen.ceiling_m / _SCALE_M, 0.0, 1.0)).astype(np.uint8)
        cells = cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)
        cells[~seen.looked_at] = _UNSEEN
        turned = np.ascontiguousarray(cells.transpose(1, 0, 2)[::-1, ::-1])
        self._scale = height_px / turned.shape[0]
        size = (round(turned.shape[1] * self._scale), height_px)
        self.image = np.asarray(cv2.resize(turned, size, interpolation=cv2.INTER_NEAREST), np.uint8)
        self._origin, self._shape = seen.origin, seen.ceiling_m.shape

    def outline(self, path: Array, tool: Tool | None, color: tuple[int, int, int]) -> None:
        """Draw around what the arm sweeps along joint angles (N, 6)."""
        mask = np.zeros(self.image.shape[:2], np.uint8)
        discs = [(bodies.sphere_centers(path)[:, _MOVES], bodies.SPHERES.radius[_MOVES])]
        if tool is not None:
            shape = bodies.tool_points(tool.opening_m, tool.load_m)
            T_tcp = ur5e.forward(path) @ rg2.T_FLANGE_TCP
            points = shape.points @ np.swapaxes(T_tcp[:, :3, :3], 1, 2) + T_tcp[:, None, :3, 3]
            discs.append((points, np.full(len(shape.points), shape.radius_m)))
        for centers, radius in discs:
            at = self._pixels(centers[..., 0], centers[..., 1])
            size = radius / RESOLUTION_M * self._scale
            # Each disc once: neighbouring samples draw the same pixels over and over.
            pixels = np.concatenate([at, np.broadcast_to(size[:, None], (*at.shape[:2], 1))], axis=-1).reshape(-1, 3)
            for u, v, r in np.unique(np.rint(pixels).astype(np.int32), axis=0):
                cv2.circle(mask, (int(u), int(v)), max(1, int(r)), 1, -1)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(self.image, contours, -1, color, 1, cv2.LINE_AA)

    def text(self, text: str, x: float, y: float) -> None:
        """Write at a place."""
        u, v = (round(float(n)) for n in self._pixels(np.array(x), np.array(y)))
        for color, thickness in ((_BLACK, 3), (_WHITE, 1)):
            cv2.putText(self.image, text, (u, v), cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, thickness, cv2.LINE_AA)

    def cross(self, x: float, y: float) -> None:
        """Mark a place."""
        u, v = (round(float(n)) for n in self._pixels(np.array(x), np.array(y)))
        for color, thickness in ((_BLACK, 5), (_BLOCKED, 2)):
            cv2.drawMarker(self.image, (u, v), color, cv2.MARKER_TILTED_CROSS, 24, thickness, cv2.LINE_AA)

    def caption(self, text: str) -> None:
        """Write at the lower border."""
        at = (10, self.image.shape[0] - 12)
        cv2.putText(self.image, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)

    def _pixels(self, x: Array, y: Array) -> Array:
        """(..., 2) column and row of places."""
        rows, cols = self._shape
        col, row = (x - self._origin[0]) / RESOLUTION_M, (y - self._origin[1]) / RESOLUTION_M
        return np.stack([(rows - row) * self._scale, (cols - col) * self._scale], axis=-1)


def _traffic_light(share: float) -> tuple[int, int, int]:
    """From red at 0 over yellow to green at 1."""
    share = min(max(share, 0.0), 1.0)
    return round(255 * min(1.0, 2 - 2 * share)), round(220 * min(1.0, 2 * share)), 40
