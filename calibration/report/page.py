"""The report of a calibration: one HTML file with everything in it, to read, keep and print."""

from __future__ import annotations

import base64
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from calibration.collect.session import image_path, read_views
from calibration.report import plots
from calibration.report.reprojection import reprojection_residuals
from calibration.report.scene import scene
from calibration.solve.pipeline import solve
from robotcell.geometry.transforms import matrix_to_rotvec
from robotcell.io.html_page import write_html_page

if TYPE_CHECKING:
    from calibration.report.reprojection import Residual
    from calibration.solve.solution import Solution, ViewErrors

_TEMPLATE = Path(__file__).with_name("report.html.j2")
_PICTURE_WIDTH_PX = 640
_JPEG_QUALITY = 75


def write_report(solution: Solution, path: Path, session: Path | None = None) -> None:
    """Write the report.

    Args:
        solution: accepted or not.
        path: of the HTML file.
        session: folder with the images of the views; None where there are none.

    Raises:
        StorageError: it cannot be written.
    """
    write_html_page(path, _TEMPLATE, _content(solution, session))


def rebuild_report(source: Path, path: Path) -> Solution:
    """Solve recorded views again, and write the report of it.

    Args:
        source: folder of a session, or another program's pairs.json or corners.json.
        path: of the HTML file.

    Raises:
        ConfigError: the source cannot be read, or something in it is wrong.
        StorageError: the report cannot be written.
    """
    solution = solve(read_views(source))
    write_report(solution, path, source if source.is_dir() else None)
    return solution


def _content(solution: Solution, session: Path | None) -> dict[str, Any]:
    views = solution.views
    residuals = reprojection_residuals(solution)
    magnify = plots.magnification(residuals.values()) if residuals else 1.0
    units = (("mm", "millimetres"), ("deg", "degrees"), ("px", "pixels"))
    return {
        "date": f"{views.date:%Y-%m-%d %H:%M}",
        "software": f"robotcell {version('robotcell')}",
        "camera": views.camera,
        "accepted": solution.accepted,
        "words": solution.verdict.words,
        "cure": solution.verdict.cure,
        "result": _result(solution),
        "scene": scene(solution),
        "spreads": [(name, spread) for unit, name in units if (spread := solution.spread(unit))],
        "bars": plots.errors_by_view(solution),
        "facts": _facts(solution),
        "left_out": [error for error in solution.errors if not error.used],
        "tilts": plots.directions(solution),
        "distances": plots.distances(solution),
        "coverage": plots.image_coverage(solution, residuals, magnify),
        "magnify": magnify,
        "pictures": _pictures(solution, session, residuals, magnify) if session else [],
    }


def _result(solution: Solution) -> dict[str, Any] | None:
    estimate = solution.estimate
    if estimate is None or not solution.accepted:
        return None
    sigma = np.sqrt(np.diag(estimate.covariance))
    return {
        "name": "T_base_camera" if solution.views.mount == "fixed" else "T_flange_camera",
        "position_mm": (1000 * estimate.X[:3, 3]).tolist(),
        "sigma_mm": (1000 * sigma[:3]).tolist(),
        "rotation_deg": np.degrees(matrix_to_rotvec(estimate.X[:3, :3])).tolist(),
        "sigma_deg": np.degrees(sigma[3:]).tolist(),
        "matrix": "\n".join("  ".join(f"{value: .6f}" for value in row) for row in estimate.X),
    }


def _facts(solution: Solution) -> list[tuple[str, str]]:
    views, estimate = solution.views, solution.estimate
    facts = [("views", f"{sum(error.used for error in solution.errors)} used of {len(views)}")]
    if solution.rotation_spread_deg:
        turns = ", ".join(f"{angle:.0f}" for angle in solution.rotation_spread_deg)
        facts.append(("turns between views", f"{turns} degrees rms about three axes"))
    if views.board is not None:
        board = views.board.model_dump()
        described = f"{len(views.board.corners())} points"
        if "squares_x" in board:
            described = (
                f"ChArUco, {board['squares_x']} x {board['squares_y']} squares of {1000 * board['square_m']:g} mm, "
                f"markers of {1000 * board['marker_m']:g} mm, {board['dictionary']}"
            )
        facts.append(("board", described))
    if estimate is not None:
        facts.append(("size of the board", f"{estimate.scale:.4f} ± {estimate.scale_sigma:.4f} of what it should be"))
        facts.append(("noise", ", ".join(f"{name} {value:.2g}" for name, value in estimate.noise.items())))
        facts.append(("method", estimate.method))
        if estimate.depth:
            depth = estimate.depth
            facts.append(
                (
                    "depth image",
                    f"true = {depth.scale:.4f} measured {1000 * depth.offset_m:+.2f} mm; "
                    f"{1000 * depth.rms_before_m:.2f} mm rms before, {1000 * depth.rms_after_m:.2f} after",
                )
            )
    return facts


def _pictures(
    solution: Solution, session: Path, residuals: dict[str, Residual], magnify: float
) -> list[dict[str, Any]]:
    pictures = []
    for error in solution.errors:
        image = cv2.imread(str(image_path(session, error.name)))
        if image is None:
            continue
        height, width = image.shape[:2]
        size = (_PICTURE_WIDTH_PX, round(height * _PICTURE_WIDTH_PX / width))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        drawn = plots.arrows(residuals[error.name], magnify, "arrow") if error.name in residuals else []
        pictures.append(
            {
                "name": error.name,
                "used": error.used,
                "width": width,
                "height": height,
                "jpeg": base64.b64encode(jpeg.tobytes()).decode("ascii"),
                "arrows": "".join(drawn),
                "caption": _caption(error),
            }
        )
    return pictures


def _caption(error: ViewErrors) -> str:
    words = []
    if error.mm is not None and error.deg is not None:
        words.append(f"{error.mm:.2f} mm, {error.deg:.3f}°")
    if error.px is not None:
        words.append(f"{error.px:.2f} px")
    if not error.used:
        words.append(f"left out: {error.why}")
    return ", ".join(words)
