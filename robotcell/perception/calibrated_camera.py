"""The cell's camera as its calibration has it: pose, intrinsics and depth correction, applied together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
import numpy.typing as npt

from robotcell.errors import CalibrationError
from robotcell.geometry.transforms import Array, check_transform, invert_transform, transform_points

if TYPE_CHECKING:
    from robotcell.config import CameraMount
    from robotcell.config.calibration_file import CameraModel, DepthCorrection
    from robotcell.interfaces import Intrinsics, RgbdFrame


@dataclass(frozen=True, eq=False)
class CalibratedCamera:
    """What turns the pixels of a frame into points of the cell.

    Attributes:
        T_base_camera: pose (4, 4) of the colour optical frame.
        model: refined intrinsics; None where those of the frame hold.
        depth: correction of the depth image; None where it is right as it comes.
    """

    T_base_camera: Array
    model: CameraModel | None = None
    depth: DepthCorrection | None = None

    def __post_init__(self) -> None:
        check_transform(self.T_base_camera, "T_base_camera")

    @staticmethod
    def of(mount: CameraMount) -> CalibratedCamera:
        """The camera of a cell: by its calibration file, or by the pose that the cell's file gives."""
        measured = mount.measured
        if measured is None:
            return CalibratedCamera(mount.pose())
        return CalibratedCamera(mount.pose(), measured.camera if measured.intrinsics_refined else None, measured.depth)

    @property
    def position(self) -> Array:
        """(3,) of the camera, base frame [m]."""
        return self.T_base_camera[:3, 3]

    def depth_m(self, frame: RgbdFrame) -> npt.NDArray[np.float32]:
        """The corrected depth (H, W) [m] of a frame; 0 = no return."""
        if self.depth is None:
            return frame.depth_m
        scale, offset = np.float32(self.depth.scale), np.float32(self.depth.offset_m)
        return np.asarray(np.where(frame.depth_m > 0, scale * frame.depth_m + offset, 0), np.float32)

    def rays(self, intrinsics: Intrinsics, crop: tuple[slice, slice]) -> Array:
        """(3, h, w) directions of the pixels of a part of the image, base axes, of length 1 along the optical axis.

        Args:
            intrinsics: of the frame.
            crop: rows and columns of the image.

        Raises:
            CalibrationError: the frame is of another resolution than the calibration.
        """
        v, u = np.mgrid[crop].astype(np.float64)
        K, dist = self._pinhole(intrinsics)
        if dist.any():
            pixels = np.stack([u.ravel(), v.ravel()], axis=-1)[:, None]
            x, y = cv2.undistortPoints(pixels, K, dist)[:, 0].T.reshape(2, *u.shape) if u.size else (u, v)
        else:
            x, y = (u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1]
        return np.asarray(np.einsum("ij,jvu->ivu", self.T_base_camera[:3, :3], np.stack([x, y, np.ones_like(x)])))

    def project(self, points: npt.NDArray[np.floating], intrinsics: Intrinsics) -> Array:
        """(N, 3) column, row [px] and depth [m] of points (N, 3) of the base frame; a depth <= 0 is behind the camera.

        Raises:
            CalibrationError: the frame is of another resolution than the calibration.
        """
        seen = np.asarray(transform_points(invert_transform(self.T_base_camera), points), np.float64)
        K, dist = self._pinhole(intrinsics)
        if dist.any():
            px = cv2.projectPoints(seen[:, None], np.zeros(3), np.zeros(3), K, dist)[0][:, 0]
            return np.column_stack([px, seen[:, 2]])
        with np.errstate(divide="ignore", invalid="ignore"):
            px = seen[:, :2] / seen[:, 2:] * (K[0, 0], K[1, 1]) + K[:2, 2]
        return np.column_stack([px, seen[:, 2]])

    def _pinhole(self, intrinsics: Intrinsics) -> tuple[Array, Array]:
        """Camera matrix (3, 3) and OpenCV's distortion (n,) of frames with these intrinsics."""
        if self.model is None:
            return _matrix(intrinsics), np.zeros(0)
        size, own = (intrinsics.width, intrinsics.height), (self.model.width, self.model.height)
        if size != own:
            raise CalibrationError(
                f"the calibration is of {own[0]}x{own[1]} and the frame of {size[0]}x{size[1]} pixels: calibrate again "
                "at camera.resolution, or set camera.resolution to that of the calibration"
            )
        return _matrix(self.model), np.array(self.model.dist, np.float64)


def _matrix(optics: Intrinsics | CameraModel) -> Array:
    return np.array([[optics.fx, 0.0, optics.cx], [0.0, optics.fy, optics.cy], [0.0, 0.0, 1.0]])
