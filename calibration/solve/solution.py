"""What a solve gives: transforms, errors, covariance, verdict; as JSON, and as the cell's calibration file."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.config.calibration_file import (
    CameraCalibration,
    CameraModel,
    DepthCorrection,
    HeldOutErrors,
    Spread,
)
from robotcell.errors import CalibrationError, ConfigError

if TYPE_CHECKING:
    from calibration.solve.depth_correction import DepthFit
    from calibration.solve.verdict import Verdict
    from calibration.solve.views import Views
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class ViewErrors:
    """What one view is off by when it takes no part in the solving.

    Attributes:
        name: of the view.
        used: whether it took part in the result.
        why: why it did not; empty if it did.
        mm: distance between the board (its centre; its origin where there are no corners) as seen and as carried.
        deg: angle between the two.
        px: corners as seen and as predicted from the arm's pose, root mean square; None without corners.
    """

    name: str
    used: bool
    why: str = ""
    mm: float | None = None
    deg: float | None = None
    px: float | None = None


@dataclass(frozen=True)
class Estimate:
    """What was estimated, whether it may be used or not.

    Attributes:
        X: T_base_camera of a fixed camera, T_flange_camera of one on the flange (4, 4).
        Z: T_flange_board with a fixed camera, T_base_board with one on the flange (4, 4).
        covariance: (6, 6) of the small change of X: position [m], rotation vector [rad], axes of its parent frame.
        camera: with its intrinsics, refined or as given; None where there were only poses.
        intrinsics_refined: whether they were.
        method: what gave it.
        noise: standard deviations that were estimated, by name with unit.
        scale: true distance over the camera's distance, estimated apart from the result.
        scale_sigma: its standard deviation.
        depth: of the depth image; None without samples.
    """

    X: Array
    Z: Array
    covariance: Array
    camera: CameraModel | None
    intrinsics_refined: bool
    method: str
    noise: dict[str, float]
    scale: float
    scale_sigma: float
    depth: DepthFit | None = None


@dataclass(frozen=True)
class Solution:
    """The outcome of a solve.

    Attributes:
        views: that it was solved from, all of them.
        verdict: whether it may be used.
        errors: one per view, in the views' order.
        estimate: None where the views were refused before anything could be estimated.
        rotation_spread_deg: (3,) turns between the usable views about three orthogonal axes, rms.
    """

    views: Views
    verdict: Verdict
    errors: tuple[ViewErrors, ...]
    estimate: Estimate | None = None
    rotation_spread_deg: tuple[float, ...] = field(default=())

    @property
    def accepted(self) -> bool:
        """Whether the result may be used."""
        return self.verdict.accepted

    @property
    def rejected(self) -> tuple[str, ...]:
        """Names of the views that took no part."""
        return tuple(view.name for view in self.errors if not view.used)

    def spread(self, unit: str) -> Spread | None:
        """Held-out error of the used views in "mm", "deg" or "px"; None where it was not measured."""
        values = [getattr(view, unit) for view in self.errors if view.used and getattr(view, unit) is not None]
        if not values:
            return None
        return Spread(
            mean=float(np.mean(values)), median=float(np.median(values)), p95=float(np.percentile(values, 95))
        )

    def as_json(self) -> dict[str, Any]:
        """Everything, in plain values. A refused result has no transforms."""
        fixed = self.views.mount == "fixed"
        estimate = self.estimate
        given = estimate if self.accepted else None
        held_out = {}
        for unit in ("mm", "deg", "px"):
            spread = self.spread(unit)
            per_view = {v.name: getattr(v, unit) for v in self.errors if getattr(v, unit) is not None}
            held_out[unit] = spread.model_dump() | {"per_view": per_view} if spread else None
        return {
            "mount": self.views.mount,
            "verdict": {
                "accepted": self.accepted,
                "reason": self.verdict.reason.value if self.verdict.reason else None,
                "words": self.verdict.words,
                "cure": self.verdict.cure,
            },
            "T_base_camera" if fixed else "T_flange_camera": given.X.tolist() if given else None,
            "T_flange_board" if fixed else "T_base_board": given.Z.tolist() if given else None,
            "covariance": given.covariance.tolist() if given else None,
            "held_out": held_out,
            "views": len(self.views),
            "used_views": sum(view.used for view in self.errors),
            "rejected_views": list(self.rejected),
            "rejected_because": {view.name: view.why for view in self.errors if not view.used},
            "rotation_spread_deg": list(self.rotation_spread_deg),
            "scale": {"value": estimate.scale, "sigma": estimate.scale_sigma} if estimate else None,
            "noise": estimate.noise if estimate else None,
            "time_offset_s": self.views.time_offset_s,
            "intrinsics": estimate.camera.model_dump() if estimate and estimate.camera else None,
            "intrinsics_refined": estimate.intrinsics_refined if estimate else False,
            "depth": vars(estimate.depth) if estimate and estimate.depth else None,
            "method": estimate.method if estimate else None,
        }

    def calibration(self) -> CameraCalibration:
        """The content of the calibration file.

        Raises:
            CalibrationError: the result was refused.
            ConfigError: the views do not say which camera took them.
        """
        estimate, mm, deg = self.estimate, self.spread("mm"), self.spread("deg")
        if not self.accepted or estimate is None or mm is None or deg is None:
            raise CalibrationError(f"refused ({self.verdict.words}): nothing is written. {self.verdict.cure}")
        if estimate.camera is None:
            raise ConfigError(
                "poses alone do not say which camera took them, nor its intrinsics: no file can be written from them"
            )
        fixed = self.views.mount == "fixed"
        depth = estimate.depth
        return CameraCalibration.model_validate(
            {
                "mount": self.views.mount,
                "T_base_camera" if fixed else "T_flange_camera": estimate.X.tolist(),
                "T_flange_board" if fixed else "T_base_board": estimate.Z.tolist(),
                "covariance": ((estimate.covariance + estimate.covariance.T) / 2).tolist(),
                "camera": estimate.camera,
                "intrinsics_refined": estimate.intrinsics_refined,
                "board": self.views.board,
                "date": self.views.date,
                "views": sum(view.used for view in self.errors),
                "rejected": self.rejected,
                "held_out": HeldOutErrors(mm=mm, deg=deg, px=self.spread("px")),
                "depth": DepthCorrection(scale=depth.scale, offset_m=depth.offset_m) if depth else None,
                "method": estimate.method,
                "software": f"robotcell {version('robotcell')}",
            }
        )
