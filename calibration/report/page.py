"""The report of a calibration: one HTML file with everything in it, to read, keep and print."""

from __future__ import annotations

import base64
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import jinja2
import numpy as np

from calibration.collect.session import image_path
from calibration.report import figures
from robotcell.errors import ConfigError
from robotcell.geometry.transforms import matrix_to_rotvec

if TYPE_CHECKING:
    from calibration.solve.solution import Solution, ViewErrors

_TEMPLATE = "report.html.j2"
_PICTURE_WIDTH_PX = 640
_JPEG_QUALITY = 75


def write_report(solution: Solution, path: Path, session: Path | None = None) -> None:
    """Write the report.

    Args:
        solution: accepted or not.
        path: of the HTML file.
        session: folder with the images of the views; None where there are none.

    Raises:
        ConfigError: it cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    page = environment.get_template(_TEMPLATE).render(_content(solution, session))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def _content(solution: Solution, session: Path | None) -> dict[str, Any]:
    views = solution.views
    residuals = figures.residuals(solution)
    units = (("mm", "millimetres"), ("deg", "degrees"), ("px", "pixels"))
    return {
        "date": f"{views.date:%Y-%m-%d %H:%M}",
        "software": f"robotcell {version('robotcell')}",
        "camera": views.camera,
        "accepted": solution.accepted,
        "words": solution.verdict.words,
        "cure": solution.verdict.cure,
        "result": _result(solution),
        "scene": figures.scene(solution),
        "spreads": [(name, spread) for unit, name in units if (spread := solution.spread(unit))],
        "bars": figures.errors_by_view(solution),
        "facts": _facts(solution),
        "left_out": [error for error in solution.errors if not error.used],
        "tilts": figures.directions(solution),
        "distances": figures.distances(solution),
        "coverage": figures.image_coverage(solution),
        "magnify": figures.magnification(residuals.values()) if residuals else 1.0,
        "pictures": _pictures(solution, session, residuals) if session else [],
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


def _pictures(solution: Solution, session: Path, residuals: dict[str, figures.Residual]) -> list[dict[str, Any]]:
    magnify = figures.magnification(residuals.values()) if residuals else 1.0
    pictures = []
    for error in solution.errors:
        image = cv2.imread(str(image_path(session, error.name)))
        if image is None:
            continue
        height, width = image.shape[:2]
        size = (_PICTURE_WIDTH_PX, round(height * _PICTURE_WIDTH_PX / width))
        small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        jpeg = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
        drawn = figures.arrows(residuals[error.name], magnify, "arrow") if error.name in residuals else []
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
