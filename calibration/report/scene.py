"""Camera, boards and arm base, drawn to scale from two sides."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.report.svg import drawing, line, text
from robotcell.geometry.transforms import transform_points

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from calibration.solve.solution import Solution
    from robotcell.geometry.transforms import Array

_RECTANGLE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def scene(solution: Solution) -> str:
    """Camera, boards and the arm's base from the side and from above, to scale, in the frame of the base."""
    views, estimate = solution.views, solution.estimate
    if estimate is None or not solution.accepted:
        return ""
    fixed = views.mount == "fixed"
    T_base_flange = views.T_base_flange
    cameras = estimate.X[None] if fixed else T_base_flange @ estimate.X
    boards = T_base_flange @ estimate.Z if fixed else estimate.Z[None]
    outline = _board_outline(solution)
    points = np.concatenate(
        [transform_points(T, outline) for T in boards] + [T[None, :3, 3] for T in cameras] + [np.zeros((1, 3))]
    )
    low, high = points.min(axis=0) - 0.12, points.max(axis=0) + 0.12
    panels = []
    for title, axes in (("from the side", (0, 2)), ("from above", (0, 1))):
        panels.append(_panel(title, axes, low, high, cameras, [transform_points(T, outline) for T in boards]))
    return "".join(panels)


def _panel(
    title: str,
    axes: tuple[int, int],
    low: Array,
    high: Array,
    cameras: Array,
    boards: Sequence[npt.NDArray[np.floating]],
) -> str:
    scale = 460 / float(high[0] - low[0])
    width, height = ((high[a] - low[a]) * scale for a in axes)
    names = "xyz"

    def place(point: npt.NDArray[np.floating]) -> tuple[float, float]:
        return float((point[axes[0]] - low[axes[0]]) * scale), float(height - (point[axes[1]] - low[axes[1]]) * scale)

    parts = []
    for a, other in (axes, axes[::-1]):
        for tick in np.arange(np.ceil(low[a] * 5) / 5, high[a], 0.2):
            ends = np.zeros((2, 3))
            ends[:, a] = tick
            ends[:, other] = low[other], high[other]
            parts.append(line(place(ends[0]), place(ends[1]), "grid"))
            label = place(ends[0])
            offset = (3, -4) if a == axes[0] else (3, -3)
            parts.append(
                text((label[0] + offset[0], label[1] + offset[1]), f"{names[a]} {round(tick, 1) + 0:.1f}", "start")
            )
    for outline in boards:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, outline))
        parts.append(f'<polygon class="board" points="{path}"/>')
    for axis, style in enumerate(("x", "y", "z")):
        if axis in axes:
            parts.append(line(place(np.zeros(3)), place(0.1 * np.eye(3)[axis]), f"axis {style}"))
    parts.append(text((place(np.zeros(3))[0] + 6, place(np.zeros(3))[1] + 14), "base", "start"))
    for T in cameras:
        eye, depth = T[:3, 3], 0.12
        corners = [transform_points(T, depth * np.array([sx * 0.62, sy * 0.36, 1.0])) for sx, sy in _RECTANGLE]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, corners))
        parts.append(f'<polygon class="camera" points="{path}"/>')
        parts += [line(place(eye), place(corner), "sight") for corner in corners]
    if len(cameras) == 1:
        parts.append(text((place(cameras[0][:3, 3])[0] + 8, place(cameras[0][:3, 3])[1] - 6), "camera", "start"))
    return f"<figure>{drawing(width, height, parts, title)}<figcaption>{title}</figcaption></figure>"


def _board_outline(solution: Solution) -> Array:
    """(n, 3) corners of the rectangle around the board's points, in its frame."""
    board = solution.views.board
    points = np.array(list(board.corners().values())) if board else np.array([[0.05, 0.05, 0.0], [-0.05, -0.05, 0.0]])
    (x0, y0, z0), (x1, y1, _) = points.min(axis=0), points.max(axis=0)
    return np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])
