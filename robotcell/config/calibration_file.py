"""The camera calibration file: where the camera stands, how sure that is, and for which camera it holds.

One versioned JSON file. `calibration` writes it; the cell reads it through `camera.calibration` in cell.toml.
Metres, radians; errors in millimetres, degrees and pixels, as their names say.
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, AwareDatetime, BaseModel, ConfigDict, Field, ValidationError, model_validator

from robotcell.errors import CalibrationError, ConfigError
from robotcell.geometry.transforms import Array, check_transform
from robotcell.io.atomic_file import make_folder, write_whole
from robotcell.io.input_file import read_json

if TYPE_CHECKING:
    from pathlib import Path

VERSION = 1
# One with all its views and tags is below 100 kB.
_MAX_BYTES = 16_000_000
# A camera on a post moves when somebody leans on it; half a year is about how long nobody remembers.
MAX_AGE = timedelta(days=180)

_Row2: TypeAlias = tuple[float, float]
_Row4: TypeAlias = tuple[float, float, float, float]
_Row6: TypeAlias = tuple[float, float, float, float, float, float]


def _rigid(T: tuple[_Row4, _Row4, _Row4, _Row4]) -> tuple[_Row4, _Row4, _Row4, _Row4]:
    check_transform(T, "the matrix")
    return T


def _covariance(matrix: tuple[_Row6, ...]) -> tuple[_Row6, ...]:
    values = np.array(matrix)
    scale = np.sqrt(np.outer(np.diag(values), np.diag(values))) if (np.diag(values) > 0).all() else None
    if scale is None or not np.allclose(values, values.T) or np.linalg.eigvalsh(values / scale)[0] < -1e-6:
        raise ValueError("not a covariance: it must be symmetric with positive eigenvalues")
    return matrix


Transform = Annotated[tuple[_Row4, _Row4, _Row4, _Row4], AfterValidator(_rigid)]
Covariance = Annotated[tuple[_Row6, _Row6, _Row6, _Row6, _Row6, _Row6], AfterValidator(_covariance)]
Point = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0)]
Distance = Annotated[float, Field(ge=0)]
Mount = Literal["fixed", "flange"]


class _Record(BaseModel):
    """A part of the file: unknown keys are refused, numbers are finite, nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class CharucoBoard(_Record):
    """A ChArUco board in OpenCV's current layout: id 0 is the inner corner next to the board frame's origin.

    Attributes:
        squares_x: squares along board x.
        squares_y: squares along board y.
        square_m: side of a square.
        marker_m: side of a marker.
        dictionary: name of the ArUco dictionary, as "DICT_5X5_100".
    """

    squares_x: Annotated[int, Field(ge=3, le=100)]
    squares_y: Annotated[int, Field(ge=3, le=100)]
    square_m: Positive
    marker_m: Positive
    dictionary: Annotated[str, Field(pattern=r"^DICT_\w+$")]

    @model_validator(mode="after")
    def _marker_fits(self) -> CharucoBoard:
        if self.marker_m >= self.square_m:
            raise ValueError("marker_m must be below square_m")
        return self

    def corners(self) -> dict[int, Point]:
        """The inner corners in the board frame [m] by id: x and y along the rows, z = 0."""
        columns, rows = self.squares_x - 1, self.squares_y - 1
        return {
            row * columns + col: ((col + 1) * self.square_m, (row + 1) * self.square_m, 0.0)
            for row in range(rows)
            for col in range(columns)
        }


class PointBoard(_Record):
    """Any rigid set of points that can be told apart.

    Attributes:
        points: position in the board frame [m] by id.
    """

    points: Annotated[dict[int, Point], Field(min_length=4)]

    def corners(self) -> dict[int, Point]:
        """The points in the board frame [m] by id."""
        return self.points


Board: TypeAlias = CharucoBoard | PointBoard


class CameraModel(_Record):
    """Pinhole with OpenCV's distortion, at one resolution.

    Attributes:
        serial: of the device; None where it is not known.
        width: of the image [px].
        height: of the image [px].
        fx: focal length [px], likewise fy.
        fy: see fx.
        cx: principal point [px], the centre of the first pixel is 0, likewise cy.
        cy: see cx.
        dist: k1, k2, p1, p2, k3 in OpenCV's order; none for a picture without distortion.
    """

    serial: str | None = None
    width: Annotated[int, Field(ge=16, le=20000)]
    height: Annotated[int, Field(ge=16, le=20000)]
    fx: Positive
    fy: Positive
    cx: float
    cy: float
    dist: tuple[float, ...] = ()

    @model_validator(mode="after")
    def _known_distortion(self) -> CameraModel:
        if len(self.dist) not in (0, 4, 5):
            raise ValueError(f"dist has {len(self.dist)} numbers; it holds none, k1 k2 p1 p2, or k1 k2 p1 p2 k3")
        return self


class Spread(_Record):
    """Mean, median and 95th percentile of an error over the views."""

    mean: Distance
    median: Distance
    p95: Distance


class HeldOutErrors(_Record):
    """What a view that took no part in the solving is off by.

    Attributes:
        mm: distance between the board's centre as seen by the camera and as carried by the arm [mm].
        deg: angle between the two [degrees].
        px: corners as seen and as predicted from the arm's pose, root mean square of a view [px]; None without corners.
    """

    mm: Spread
    deg: Spread
    px: Spread | None = None


class DepthCorrection(_Record):
    """True depth = scale * measured depth + offset_m, along the optical axis."""

    scale: Positive
    offset_m: float


class FixedTag(_Record):
    """A tag of the AprilTag family 36h11 that is fixed to the cell, as a fixed camera sees it.

    `robotcell.perception.tags` finds it.

    Attributes:
        id: of the tag.
        corners_px: its corners in the image [px].
    """

    id: Annotated[int, Field(ge=0, le=586)]
    corners_px: tuple[_Row2, _Row2, _Row2, _Row2]


class CameraCalibration(_Record):
    """What a calibration found.

    Attributes:
        version: of this format.
        mount: "fixed": the camera stands still and the arm carries the board; "flange": the other way round.
        T_base_camera: pose of the colour optical frame (OpenCV axes) in the base frame; of a fixed camera only.
        T_flange_camera: the same in the flange frame; of a camera on the flange only.
        T_flange_board: pose of the board on the flange; with a fixed camera only.
        T_base_board: pose of the board in the base frame; with a camera on the flange only.
        covariance: (6, 6) of the camera's transform, in the sense of `covariance_of`.
        covariance_of: what the six numbers are: position error d [m], then rotation vector w [rad], both in axes of the
            base (fixed) or the flange (on the flange): true rotation = exp(w) R, true position = t + d.
        camera: the device, its resolution and its intrinsics.
        intrinsics_refined: the intrinsics were estimated together with the pose.
        board: what was looked at; None for pose pairs.
        date: of the last view.
        views: how many stand behind the result.
        rejected: names of the views that were left out.
        held_out: errors of held-out views.
        depth: correction of the depth image; None without depth samples.
        tags: fixed tags that were in view, to see later whether the camera was moved.
        method: closed form that gave the start, and what refined it.
        software: that wrote the file.
    """

    version: Literal[1] = 1
    mount: Mount
    T_base_camera: Transform | None = None
    T_flange_camera: Transform | None = None
    T_flange_board: Transform | None = None
    T_base_board: Transform | None = None
    covariance: Covariance
    covariance_of: Literal["position [m], rotation vector [rad]; left, axes of the parent frame"] = (
        "position [m], rotation vector [rad]; left, axes of the parent frame"
    )
    camera: CameraModel
    intrinsics_refined: bool = False
    board: Board | None = None
    date: AwareDatetime
    views: Annotated[int, Field(ge=1)]
    rejected: tuple[str, ...] = ()
    held_out: HeldOutErrors
    depth: DepthCorrection | None = None
    tags: tuple[FixedTag, ...] = ()
    method: str
    software: str

    @model_validator(mode="after")
    def _transforms_fit_the_mount(self) -> CameraCalibration:
        fixed = self.mount == "fixed"
        for name, needed in (
            ("T_base_camera", fixed),
            ("T_flange_board", fixed),
            ("T_flange_camera", not fixed),
            ("T_base_board", not fixed),
        ):
            if (getattr(self, name) is not None) != needed:
                raise ValueError(f'mount "{self.mount}" {"needs" if needed else "has no"} {name}')
        return self

    def pose(self) -> Array:
        """The camera (4, 4) in its parent frame: T_base_camera, or T_flange_camera."""
        T = self.T_base_camera if self.mount == "fixed" else self.T_flange_camera
        return np.array(T, dtype=np.float64)

    def check(
        self,
        *,
        serial: str | None = None,
        resolution: tuple[int, int] | None = None,
        max_age: timedelta = MAX_AGE,
        now: datetime | None = None,
    ) -> None:
        """Refuse a calibration of another camera, of another resolution, or of long ago.

        Args:
            serial: of the camera in use; None where it cannot be known.
            resolution: (width, height) in use; None to leave it unchecked.
            max_age: the oldest that is accepted.
            now: the time to compare with; the system's unless given.

        Raises:
            CalibrationError: naming everything that does not fit.
        """
        now = now or datetime.now(timezone.utc)
        problems = []
        if serial is not None and self.camera.serial is not None and serial != self.camera.serial:
            problems.append(f"it is of the camera {self.camera.serial}, and {serial} is in use")
        size = (self.camera.width, self.camera.height)
        if resolution is not None and resolution != size:
            problems.append(f"it is of {size[0]}x{size[1]}, and {resolution[0]}x{resolution[1]} is in use")
        age = now - self.date
        if age > max_age:
            problems.append(f"it is {age.days} days old, and {max_age.days} are allowed")
        if age < -timedelta(days=1):
            problems.append(f"it is dated {self.date:%Y-%m-%d}, after today; check the clock")
        if problems:
            raise CalibrationError(f"the calibration does not fit: {'; '.join(problems)}. Calibrate again")


def load_calibration(path: Path) -> CameraCalibration:
    """Read a calibration file.

    Raises:
        ConfigError: it cannot be read or is none; the message names every wrong key.
    """
    values = read_json(path, _MAX_BYTES, "make one with robotcell calibrate")
    version = values.get("version") if isinstance(values, dict) else None
    if version is None:
        raise ConfigError(f"{path}: not a calibration file: it has no version")
    if version != VERSION:
        raise ConfigError(f"{path}: version {version}; this program reads {VERSION}. Calibrate again")
    try:
        return CameraCalibration.model_validate(values)
    except ValidationError as error:
        problems = [
            f"{'.'.join(str(part) for part in detail['loc']) or 'file'}: {detail['msg'].removeprefix('Value error, ')}"
            for detail in error.errors()
        ]
        raise ConfigError("\n  ".join([f"{path}: {len(problems)} wrong value(s)", *problems])) from error


def save_calibration(calibration: CameraCalibration, path: Path) -> None:
    """Write a calibration file, as a whole or not at all. What stands there is replaced.

    Raises:
        StorageError: it cannot be written.
    """
    make_folder(path.parent)
    write_whole(path, calibration.model_dump_json(indent=1, exclude_none=True) + "\n")
