"""What a calibration is solved from: where the flange was, and what the camera saw of the board."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from calibration.solve.se3 import invert

if TYPE_CHECKING:
    from collections.abc import Sequence
    from datetime import datetime

    import numpy as np
    import numpy.typing as npt

    from robotcell.config.calibration_file import Board, CameraModel, Mount
    from robotcell.geometry.transforms import Array


@dataclass(frozen=True)
class Corners:
    """The corners of the board that one image shows.

    Attributes:
        ids: (n,) which corners.
        px: (n, 2) where [px], the centre of the first pixel is (0, 0).
        depth_m: (n,) depth image there [m], 0 = no return; None without a depth image.
    """

    ids: npt.NDArray[np.int64]
    px: Array
    depth_m: Array | None = None


@dataclass(frozen=True)
class Views:
    """Views of one board by one camera: either poses of the board, or its corners in images.

    Attributes:
        mount: "fixed": the arm carries the board; "flange": the arm carries the camera.
        names: one per view.
        T_base_flange: (V, 4, 4).
        date: of the last view.
        T_camera_board: (V, 4, 4); None where there are corners.
        corners: one per view; None where there are only poses.
        camera: that took the images; None where there are only poses.
        board: that was seen; None where there are only poses.
        time_offset_s: clock of the board's poses minus clock of the flange's; None where each pair is one record.
    """

    mount: Mount
    names: tuple[str, ...]
    T_base_flange: Array
    date: datetime
    T_camera_board: Array | None = None
    corners: tuple[Corners, ...] | None = None
    camera: CameraModel | None = None
    board: Board | None = None
    time_offset_s: float | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def T_parent_child(self) -> Array:  # noqa: N802 (notation of the field)
        """(V, 4, 4): the body that carries the board, in the body that carries the camera.

        T_base_flange with a fixed camera, T_flange_base with one on the flange; so that with
        X = T_parent_camera and Z = T_child_board, T_camera_board = inv(X) T_parent_child Z for both mounts.
        """
        return self.T_base_flange if self.mount == "fixed" else invert(self.T_base_flange)

    def subset(self, indices: Sequence[int] | npt.NDArray[np.int64]) -> Views:
        """Some of the views, in the given order."""
        chosen = [int(i) for i in indices]
        return replace(
            self,
            names=tuple(self.names[i] for i in chosen),
            T_base_flange=self.T_base_flange[chosen],
            T_camera_board=None if self.T_camera_board is None else self.T_camera_board[chosen],
            corners=None if self.corners is None else tuple(self.corners[i] for i in chosen),
        )
