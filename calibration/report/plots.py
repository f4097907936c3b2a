"""The plots of the report."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from calibration.report.reprojection import board_poses
from calibration.report.svg import drawing, escape, interpolate, line, round_step, text

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from calibration.report.reprojection import Residual
    from calibration.solve.solution import Solution


def errors_by_view(solution: Solution) -> str:
    """Bars of the held-out error [mm], one per view; those left out are hollow."""
    errors = [(e.name, e.mm, e.used) for e in solution.errors if e.mm is not None]
    if not errors:
        return ""
    width, height, left, bottom, top = 720, 200, 44, 28, 8
    used = [mm for _, mm, is_used in errors if is_used] or [mm for _, mm, _ in errors]
    # What was left out may be off by a hundred times as much; its bar is cut.
    highest = 1.15 * max(used)
    step = round_step(highest, 4)
    scale = (height - bottom - top) / highest
    pitch = (width - left - 6) / len(errors)
    parts = []
    for tick in np.arange(0, highest, step):
        y = height - bottom - tick * scale
        parts += [line((left, y), (width, y), "grid"), text((left - 6, y + 4), f"{tick:.3g}", "end")]
    for i, (name, mm, is_used) in enumerate(errors):
        x, tall = left + (i + 0.15) * pitch, min(mm, highest) * scale
        style = "bar" if is_used else "bar out"
        parts.append(
            f'<rect class="{style}" x="{x:.1f}" y="{height - bottom - tall:.1f}" width="{0.7 * pitch:.1f}" '
            f'height="{tall:.1f}"><title>{escape(name)}: {mm:.3f} mm</title></rect>'
        )
        if len(errors) <= 40:
            parts.append(text((x + 0.35 * pitch, height - bottom + 14), name.lstrip("0") or name, "middle"))
    parts.append(text((2, height - 4), "mm", "start"))
    return drawing(width, height, parts, "held-out error by view")


def image_coverage(solution: Solution, residuals: Mapping[str, Residual], magnify: float) -> str:
    """All corners in the image, with what is left of them, so many times enlarged."""
    camera = solution.estimate.camera if solution.estimate else None
    if camera is None or not residuals:
        return ""
    used = {e.name for e in solution.errors if e.used}
    parts = [f'<rect class="frame" x="0" y="0" width="{camera.width}" height="{camera.height}"/>']
    for name, residual in residuals.items():
        parts += arrows(residual, magnify, "arrow" if name in used else "arrow out")
    return drawing(camera.width, camera.height, parts, "corners in the image")


def magnification(left: Iterable[Residual]) -> float:
    """By how much residuals are enlarged, so that the usual one is as long as 15 px: 1, 2 or 5 times a power of ten."""
    sizes = np.concatenate([np.linalg.norm(r.off_px, axis=1) for r in left])
    return round_step(15 / max(float(np.median(sizes)), 1e-3), 1) if len(sizes) else 1.0


def arrows(residual: Residual, magnify: float, style: str) -> list[str]:
    """A dot for each corner, and a line along what is left of it."""
    parts = []
    for (u, v), (du, dv) in zip(residual.px, residual.off_px, strict=True):
        end = (u + magnify * du, v + magnify * dv)
        parts += [f'<circle class="{style}" cx="{u:.1f}" cy="{v:.1f}" r="3"/>', line((u, v), end, style)]
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
        parts.append(text((middle + 3, middle - radius * angle / most + 12), f"{angle}°", "start"))
    used = {e.name for e in solution.errors if e.used}
    for name, view in zip(solution.views.names, T, strict=True):
        normal = view[:3, 2] * (1 if view[2, 2] >= 0 else -1)
        tilt, way = np.degrees(np.arccos(np.clip(normal[2], -1, 1))), np.arctan2(normal[1], normal[0])
        x, y = (middle + radius * min(tilt / most, 1.1) * f(way) for f in (np.cos, np.sin))
        parts.append(_dot((x, y), name, name in used))
    return drawing(size, size, parts, "tilts of the board")


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
        y = interpolate(tick, low, high, height - bottom, top)
        parts += [line((left, y), (width, y), "grid"), text((left - 6, y + 4), f"{tick:.1f} m", "end")]
    for angle in (-180, -90, 0, 90, 180):
        x = interpolate(angle, -190, 190, left, width - 16)
        parts += [line((x, top), (x, height - bottom), "grid")]
        parts.append(text((x, height - bottom + 16), f"{angle}°", "middle"))
    used = {e.name for e in solution.errors if e.used}
    for name, angle, distance in zip(solution.views.names, turn, z, strict=True):
        place = (
            interpolate(angle, -190, 190, left, width - 16),
            interpolate(distance, low, high, height - bottom, top),
        )
        parts.append(_dot(place, name, name in used))
    return drawing(width, height, parts, "distances and turns of the board")


def _dot(place: tuple[float, float], name: str, is_used: bool) -> str:
    style, (x, y) = "dot" if is_used else "dot out", place
    return f'<circle class="{style}" cx="{x:.1f}" cy="{y:.1f}" r="4.5"><title>{escape(name)}</title></circle>'
