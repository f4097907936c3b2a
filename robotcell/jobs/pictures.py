"""Pictures of a job: one per action (camera view, heightmap with the action drawn in, heights) and an animation."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from robotcell.config.fingers import gripper_range
from robotcell.errors import StorageError
from robotcell.geometry import rg2
from robotcell.io.images import write_image
from robotcell.jobs.policy_api import PickAny
from robotcell.jobs.swept_picture import draw_obstruction, draw_plan
from robotcell.motion.clearance import Obstructed
from robotcell.motion.grasp import Grasp
from robotcell.motion.path_check import CheckedPlan
from robotcell.perception.heightmap import Heightmap, build_heightmap

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.config import CellConfig
    from robotcell.errors import UnsafeMotion
    from robotcell.findings import Finding
    from robotcell.jobs.decision import Decision
    from robotcell.jobs.verdict import Outcome
    from robotcell.motion.actions import Action
    from robotcell.perception.view import View

_Picture = npt.NDArray[np.uint8]
_ToPixel = Callable[[float, float], tuple[int, int]]

_PANEL_PX = 480
_CAPTION_PX = 34
_WHITE, _BLACK = (255, 255, 255), (0, 0, 0)
_ACTION, _GOAL = (255, 0, 200), (255, 255, 255)
_GOOD, _BAD, _NEUTRAL = (30, 120, 50), (150, 40, 30), (40, 40, 40)
# Cells that were never seen.
_UNSEEN = (60, 20, 70)
# Heights from the table to this one span the colour scale.
_SCALE_M = 0.12
_ANIMATION_WIDTH_PX = 800
_ANIMATION_STEP_MS = 900
_ANIMATION_END_MS = 2500


class JobPictures:
    """An observer of a job that leaves `step-NNN.png` and `summary.gif` in the folder of the run."""

    def __init__(self, config: CellConfig) -> None:
        self._config = config
        self._folder: Path | None = None
        self._view: View | None = None
        self._pages: list[Image.Image] = []

    def started(self, job_id: int, run_dir: Path) -> None:
        """Take the folder of the run."""
        self._folder = run_dir

    def checked(self, findings: Sequence[Finding]) -> None:
        """There is nothing to draw yet."""

    def looked(self, view: View) -> None:
        """Keep the newest view for the last page."""
        self._view = view

    def decided(self, decision: Decision) -> None:
        """The page is drawn when the outcome is known."""

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """Draw the page of an action."""
        color = _GOOD if outcome.success else _BAD
        caption = f"{describe(decision)}: {outcome.result.value} ({outcome.detail})"
        page = draw_decision(decision, self._config, caption, color)
        if self._folder:
            write_image(self._folder / f"step-{decision.index:03d}.png", page)
        self._pages.append(_small(page))

    def finish(self, caption: str) -> None:
        """Add a page of the table as it is now, and write the animation."""
        if not self._folder or not self._view:
            return
        page = draw_view(self._view, None, None, self._config, caption, _NEUTRAL)
        write_image(self._folder / "end.png", page)
        pages = [*self._pages, _small(page)]
        durations = [_ANIMATION_STEP_MS] * (len(pages) - 1) + [_ANIMATION_END_MS]
        path = self._folder / "summary.gif"
        try:
            pages[0].save(path, save_all=True, append_images=pages[1:], duration=durations, loop=0)
        except OSError as error:
            raise StorageError(f"{path} cannot be written: {error.strerror}; check the folder and the disk") from error


def describe(decision: Decision) -> str:
    """One line on a decision: its number, what it does and how sure the policy is."""
    action = decision.action
    name = "grasp" if isinstance(action, Grasp) else "push"
    goal = f" for {decision.goal}" if decision.goal else ""
    angle = f"{np.degrees(action.theta):.1f} deg"
    return f"{decision.index}. {name}{goal} at {angle}, q {action.q_value:.2f}"


def draw_decision(
    decision: Decision, config: CellConfig, caption: str, color: tuple[int, int, int] = _NEUTRAL
) -> _Picture:
    """A page (H, W, 3) uint8 RGB of a decision: camera view, heightmap with the action, heights."""
    goal = None if isinstance(decision.task, PickAny) else decision.task.mask
    return draw_view(decision.view, decision.action, goal, config, caption, color)


def draw_preview(decision: Decision, plan: CheckedPlan | UnsafeMotion, config: CellConfig, caption: str) -> _Picture:
    """The page of a decision, and beside it what its plan sweeps, or what stands in its way (H, W, 3) uint8 RGB."""
    page = draw_decision(decision, config, caption, _NEUTRAL if isinstance(plan, CheckedPlan) else _BAD)
    seen = decision.view.clearance
    if isinstance(plan, CheckedPlan):
        panel = draw_plan(plan, seen, _PANEL_PX)
    elif isinstance(plan, Obstructed):
        panel = draw_obstruction(plan.obstruction, plan.q, seen, _PANEL_PX)
    else:
        return page
    strip = np.broadcast_to(page[:1, :1], (_CAPTION_PX, panel.shape[1], 3))
    return np.hstack([page, np.vstack([strip, panel])])


def draw_view(
    view: View,
    action: Action | None,
    goal: npt.NDArray[np.bool_] | None,
    config: CellConfig,
    caption: str,
    color: tuple[int, int, int],
) -> _Picture:
    """A page (H, W, 3) uint8 RGB of a view, with an action and the outline of a goal where given.

    The heightmaps are turned so that base x points up and base y to the left, as the camera sees the table.
    """
    heightmap = view.heightmap
    if heightmap.workspace != config.workspace:
        # The policy decided on a map of its own; people see the one that the cell's file asks for.
        heightmap = build_heightmap(view.frame, view.camera, config.workspace, config.table.height_m)
    camera = _camera_panel(view, action, config)
    panels = [camera, _map_panel(heightmap, action, goal, config), _height_panel(heightmap)]
    body = np.hstack(panels)
    strip = np.full((_CAPTION_PX, body.shape[1], 3), color, np.uint8)
    cv2.putText(strip, caption, (10, 23), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _WHITE, 1, cv2.LINE_AA)
    return np.vstack([strip, body])


def _small(page: _Picture) -> Image.Image:
    height = round(page.shape[0] * _ANIMATION_WIDTH_PX / page.shape[1])
    resized = cv2.resize(page, (_ANIMATION_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
    return Image.fromarray(resized).quantize(128)


def _camera_panel(view: View, action: Action | None, config: CellConfig) -> _Picture:
    frame = view.frame
    panel = frame.color.copy()
    if action is not None:
        point = np.array([_place(action, config.table.height_m)])
        u, v, depth = view.camera.project(point, frame.intrinsics)[0]
        if depth > 0:
            size, at = frame.intrinsics.width // 40, (round(u), round(v))
            cv2.drawMarker(panel, at, _BLACK, cv2.MARKER_CROSS, size, 5)
            cv2.drawMarker(panel, at, _ACTION, cv2.MARKER_CROSS, size, 2)
    width = round(panel.shape[1] * _PANEL_PX / panel.shape[0])
    return np.asarray(cv2.resize(panel, (width, _PANEL_PX), interpolation=cv2.INTER_AREA), np.uint8)


def _place(action: Action, table_height_m: float) -> tuple[float, float, float]:
    """Where an action begins, base frame [m]: on the surface that is grasped, or at the top of what is pushed."""
    if isinstance(action, Grasp):
        return action.x, action.y, table_height_m + action.surface_m
    return *action.start, table_height_m + action.top_m


def _map_panel(
    heightmap: Heightmap, action: Action | None, goal: npt.NDArray[np.bool_] | None, config: CellConfig
) -> _Picture:
    image = heightmap.color.copy()
    image[np.isnan(heightmap.height_m)] = _UNSEEN
    panel = _turn(image)
    scale = panel.shape[0] / heightmap.workspace.shape[1]
    if goal is not None:
        outline = _turn(goal.astype(np.uint8)[..., None].repeat(3, axis=2))[..., 0].copy()
        contours, _ = cv2.findContours(outline, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
        cv2.drawContours(panel, contours, -1, _GOAL, 2)

    def pixel(x: float, y: float) -> tuple[int, int]:
        workspace = heightmap.workspace
        rows, cols = workspace.shape
        row, col = (
            (y - workspace.y[0]) / workspace.resolution_m,
            (x - workspace.x[0]) / workspace.resolution_m,
        )
        return round((rows - row) * scale), round((cols - col) * scale)

    if isinstance(action, Grasp):
        _draw_fingers(panel, action, config, pixel)
    elif action is not None:
        for color, thickness in ((_BLACK, 6), (_ACTION, 3)):
            cv2.arrowedLine(
                panel, pixel(*action.start), pixel(*action.end), color, thickness, cv2.LINE_AA, tipLength=0.2
            )
    return panel


def _draw_fingers(panel: _Picture, grasp: Grasp, config: CellConfig, pixel: _ToPixel) -> None:
    """The two finger tips at the pre-shape, and the line on which they close."""
    x, y = grasp.x, grasp.y
    along = np.array([np.cos(grasp.theta), np.sin(grasp.theta)])
    across = np.array([-along[1], along[0]]) * rg2.FINGER_BREADTH_M / 2
    inner = config.gripper.preshape_m / 2
    thickness = rg2.finger_thickness(gripper_range(config).fingertip_offset_m)
    for side in (-1, 1):
        near = np.array([x, y]) + side * inner * along
        far = near + side * thickness * along
        corners = [pixel(*p) for p in (near - across, near + across, far + across, far - across)]
        cv2.fillPoly(panel, [np.array(corners)], _ACTION, cv2.LINE_AA)
        cv2.line(panel, pixel(x, y), pixel(*near), _ACTION, 2, cv2.LINE_AA)


def _height_panel(heightmap: Heightmap) -> _Picture:
    scaled = np.nan_to_num(np.clip(heightmap.height_m / _SCALE_M, 0.0, 1.0), nan=0.0)
    image = cv2.cvtColor(cv2.applyColorMap((255 * scaled).astype(np.uint8), cv2.COLORMAP_TURBO), cv2.COLOR_BGR2RGB)
    image[np.isnan(heightmap.height_m)] = _UNSEEN
    panel = _turn(np.asarray(image, np.uint8))
    text = f"0 to {1000 * _SCALE_M:.0f} mm, dark: unseen"
    cv2.putText(panel, text, (10, _PANEL_PX - 12), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _WHITE, 1, cv2.LINE_AA)
    return panel


def _turn(image: _Picture) -> _Picture:
    """An (H, W, 3) map of rows along y and columns along x as a panel with x up and y to the left."""
    turned = np.ascontiguousarray(image.transpose(1, 0, 2)[::-1, ::-1])
    width = round(turned.shape[1] * _PANEL_PX / turned.shape[0])
    return np.asarray(cv2.resize(turned, (width, _PANEL_PX), interpolation=cv2.INTER_NEAREST), np.uint8)
