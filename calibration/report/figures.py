"""The figures of the report, as SVG that takes its colours from the page."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from calibration.solve.projection import intrinsics_vector, project
from calibration.solve.rigid import invert
from robotcell.geometry.transforms import transform_points

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy.typing as npt

    from calibration.solve.solution import Solution
    from robotcell.geometry.transforms import Array

_GRID_MM = (1.0, 2.0, 5.0)


@dataclass(frozen=True)
class Residual:
    """The corners of one view, as seen and as the arm carries them.

    Attributes:
        px: (n, 2) seen.
        off_px: (n, 2) seen minus carried.
    """

    px: Array
    off_px: Array


def residuals(solution: Solution) -> dict[str, Residual]:
    """What is left of each view, by name; empty without corners or a result."""
    views, estimate = solution.views, solution.estimate
    if views.corners is None or views.board is None or estimate is None or estimate.camera is None:
        return {}
    board, optics = views.board.corners(), intrinsics_vector(estimate.camera)
    found = {}
    for name, M, corners in zip(views.names, views.T_parent_child, views.corners, strict=True):
        points = np.array([board[int(i)] for i in corners.ids]).reshape(-1, 3)
        T_camera_board = invert(estimate.X) @ M @ estimate.Z
        px, _, _ = project(np.asarray(transform_points(T_camera_board, points), np.float64), optics, derivatives=False)
        found[name] = Residual(corners.px, corners.px - px)
    return found


def board_poses(solution: Solution) -> Array:
    """T_camera_board (V, 4, 4) of all views: as given, or as the result has them; empty without either."""
    views, estimate = solution.views, solution.estimate
    if estimate is not None:
        return np.asarray(invert(estimate.X) @ views.T_parent_child @ estimate.Z)
    return np.zeros((0, 4, 4)) if views.T_camera_board is None else views.T_camera_board


def errors_by_view(solution: Solution) -> str:
    """Bars of the held-out error [mm], one per view; those left out are hollow."""
    errors = [(e.name, e.mm, e.used) for e in solution.errors if e.mm is not None]
    if not errors:
        return ""
    width, height, left, bottom, top = 720, 200, 44, 28, 8
    used = [mm for _, mm, is_used in errors if is_used] or [mm for _, mm, _ in errors]
    # What was left out may be off by a hundred times as much; its bar is cut.
    highest = 1.15 * max(used)
    step = _step(highest, 4)
    scale = (height - bottom - top) / highest
    pitch = (width - left - 6) / len(errors)
    parts = []
    for tick in np.arange(0, highest, step):
        y = height - bottom - tick * scale
        parts += [_line((left, y), (width, y), "grid"), _text((left - 6, y + 4), f"{tick:.3g}", "end")]
    for i, (name, mm, is_used) in enumerate(errors):
        x, tall = left + (i + 0.15) * pitch, min(mm, highest) * scale
        style = "bar" if is_used else "bar out"
        parts.append(
            f'<rect class="{style}" x="{x:.1f}" y="{height - bottom - tall:.1f}" width="{0.7 * pitch:.1f}" '
            f'height="{tall:.1f}"><title>{_escape(name)}: {mm:.3f} mm</title></rect>'
        )
        if len(errors) <= 40:
            parts.append(_text((x + 0.35 * pitch, height - bottom + 14), name.lstrip("0") or name, "middle"))
    parts.append(_text((2, height - 4), "mm", "start"))
    return _svg(width, height, parts, "held-out error by view")


def image_coverage(solution: Solution) -> str:
    """All corners in the image, with what is left of them, enlarged."""
    left = residuals(solution)
    camera = solution.estimate.camera if solution.estimate else None
    if camera is None or not left:
        return ""
    used = {e.name for e in solution.errors if e.used}
    magnify = magnification(left.values())
    parts = [f'<rect class="frame" x="0" y="0" width="{camera.width}" height="{camera.height}"/>']
    for name, residual in left.items():
        parts += arrows(residual, magnify, "arrow" if name in used else "arrow out")
    return _svg(camera.width, camera.height, parts, "corners in the image")


def magnification(left: Iterable[Residual]) -> float:
    """By how much residuals are enlarged, so that the usual one is as long as 15 px: 1, 2 or 5 times a power of ten."""
    sizes = np.concatenate([np.linalg.norm(r.off_px, axis=1) for r in left])
    return _step(15 / max(float(np.median(sizes)), 1e-3), 1) if len(sizes) else 1.0


def arrows(residual: Residual, magnify: float, style: str) -> list[str]:
    """A dot for each corner, and a line along what is left of it."""
    parts = []
    for (u, v), (du, dv) in zip(residual.px, residual.off_px, strict=True):
        end = (u + magnify * du, v + magnify * dv)
        parts += [f'<circle class="{style}" cx="{u:.1f}" cy="{v:.1f}" r="3"/>', _line((u, v), end, style)]
    return parts


def directions(solution: Solution) -> str:
    """How the board was tilted (angle from the middle, direction round it) in each view."""
    T = board_poses(solution)
    if not len(T):
        return ""
    size, radius = 300, 128
    middle, most = size / 2, 60.0
    parts = []
    for angle in (15, 30, 45, 60):
        parts.append(f'<circle class="ring" cx="{middle}" cy="{middle}" r="{radius * angle / most:.1f}"/>')
        parts.append(_text((middle + 3, middle - radius * angle / most + 12), f"{angle}°", "start"))
    used = {e.name for e in solution.errors if e.used}
    for name, view in zip(solution.views.names, T, strict=True):
        normal = view[:3, 2] * (1 if view[2, 2] >= 0 else -1)
        tilt, way = np.degrees(np.arccos(np.clip(normal[2], -1, 1))), np.arctan2(normal[1], normal[0])
        x, y = (middle + radius * min(tilt / most, 1.1) * f(way) for f in (np.cos, np.sin))
        parts.append(_dot((x, y), name, name in used))
    return _svg(size, size, parts, "tilts of the board")


def distances(solution: Solution) -> str:
    """Distance of the board from the camera, over its turn in the image plane."""
    T = board_poses(solution)
    if not len(T):
        return ""
    width, height, left, bottom, top = 400, 300, 48, 36, 12
    z = T[:, 2, 3]
    turn = np.degrees(np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    low, high = float(z.min()) - 0.05, float(z.max()) + 0.05
    parts = []
    for tick in np.arange(np.ceil(low * 10) / 10, high, 0.1):
        y = _along(tick, low, high, height - bottom, top)
        parts += [_line((left, y), (width, y), "grid"), _text((left - 6, y + 4), f"{tick:.1f} m", "end")]
    for angle in (-180, -90, 0, 90, 180):
        x = _along(angle, -190, 190, left, width - 16)
        parts += [_line((x, top), (x, height - bottom), "grid")]
        parts.append(_text((x, height - bottom + 16), f"{angle}°", "middle"))
    used = {e.name for e in solution.errors if e.used}
    for name, angle, distance in zip(solution.views.names, turn, z, strict=True):
        place = (_along(angle, -190, 190, left, width - 16), _along(distance, low, high, height - bottom, top))
        parts.append(_dot(place, name, name in used))
    return _svg(width, height, parts, "distances and turns of the board")


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
            parts.append(_line(place(ends[0]), place(ends[1]), "grid"))
            label = place(ends[0])
            offset = (3, -4) if a == axes[0] else (3, -3)
            parts.append(
                _text((label[0] + offset[0], label[1] + offset[1]), f"{names[a]} {round(tick, 1) + 0:.1f}", "start")
            )
    for outline in boards:
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, outline))
        parts.append(f'<polygon class="board" points="{path}"/>')
    for axis, style in enumerate(("x", "y", "z")):
        if axis in axes:
            parts.append(_line(place(np.zeros(3)), place(0.1 * np.eye(3)[axis]), f"axis {style}"))
    parts.append(_text((place(np.zeros(3))[0] + 6, place(np.zeros(3))[1] + 14), "base", "start"))
    for T in cameras:
        eye, depth = T[:3, 3], 0.12
        corners = [transform_points(T, depth * np.array([sx * 0.62, sy * 0.36, 1.0])) for sx, sy in _RECTANGLE]
        path = " ".join(f"{x:.1f},{y:.1f}" for x, y in map(place, corners))
        parts.append(f'<polygon class="camera" points="{path}"/>')
        parts += [_line(place(eye), place(corner), "sight") for corner in corners]
    if len(cameras) == 1:
        parts.append(_text((place(cameras[0][:3, 3])[0] + 8, place(cameras[0][:3, 3])[1] - 6), "camera", "start"))
    return f"<figure>{_svg(width, height, parts, title)}<figcaption>{title}</figcaption></figure>"


_RECTANGLE = ((-1, -1), (1, -1), (1, 1), (-1, 1))


def _board_outline(solution: Solution) -> Array:
    """(n, 3) corners of the rectangle around the board's points, in its frame."""
    board = solution.views.board
    points = np.array(list(board.corners().values())) if board else np.array([[0.05, 0.05, 0.0], [-0.05, -0.05, 0.0]])
    (x0, y0, z0), (x1, y1, _) = points.min(axis=0), points.max(axis=0)
    return np.array([[x0, y0, z0], [x1, y0, z0], [x1, y1, z0], [x0, y1, z0]])


def _step(span: float, count: int) -> float:
    """1, 2 or 5 times a power of ten: about `count` of them make up `span`."""
    power = 10 ** np.floor(np.log10(span / count))
    return float(max(m * power for m in _GRID_MM if m * power <= span / count * 1.001))


def _along(value: float, low: float, high: float, start: float, end: float) -> float:
    return float(start + (value - low) / (high - low) * (end - start))


def _dot(place: tuple[float, float], name: str, is_used: bool) -> str:
    style, (x, y) = "dot" if is_used else "dot out", place
    return f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="4.5"><title>{_escape(name)}</title></circle>'


def _line(a: tuple[float, float], b: tuple[float, float], style: str) -> str:
    return f'<line class="{style}" x1="{a[0]:.1f}" y1="{a[1]:.1f}" x2="{b[0]:.1f}" y2="{b[1]:.1f}"/>'


def _text(place: tuple[float, float], words: str, anchor: str) -> str:
    return f'<text x="{place[0]:.1f}" y="{place[1]:.1f}" text-anchor="{anchor}">{_escape(words)}</text>'


def _svg(width: float, height: float, parts: Iterable[str], label: str) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{_escape(label)}">{"".join(parts)}</svg>'
    )


def _escape(words: str) -> str:
    return words.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace('"', "&quot;")
