"""One view: the arm at rest, a few frames, and where the arm was, taken together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from calibration.target.detection import Detection, average, draw
from robotcell.errors import DeviceFault
from robotcell.geometry.transforms import make_transform
from robotcell.motion.tool import flange_pose

if TYPE_CHECKING:
    from calibration.target.detection import Detector
    from robotcell.cell import Cell
    from robotcell.geometry.transforms import Array
    from robotcell.interfaces import ArmState, Intrinsics

# A median of depth needs three; more make no corner better, since its error is that of the pixel grid.
FRAMES = 3
# An arm that holds its place shows joint speeds below the first (controllers tremble a little), and moves by less than
# the second over the whole capture (0.1 mm at half a metre). It must have done so for the third.
_STILL_RAD_S = 0.03
_STILL_RAD = 2e-4
_STILL_S = 0.4
_PERIOD_S = 0.05
_PATIENCE_S = 5.0
# Corners that wander by more than this between the frames of a capture [px] are of something that moves.
_WANDER_PX = 0.5


@dataclass(frozen=True)
class Capture:
    """One view as it was captured.

    Attributes:
        t: time of its last frame on the cell's clock [s].
        color: (H, W, 3) uint8 RGB, mean of its frames.
        depth_m: (H, W) float32, median of the returns of its frames, 0 = none.
        intrinsics: of both images.
        serial: of the camera; None where it is not known.
        q: (6,) joint angles [rad], mean over its frames.
        T_base_tcp: pose of the tool centre point as the arm reports it (4, 4), likewise.
        detection: the board in it.
    """

    t: float
    color: npt.NDArray[np.uint8]
    depth_m: npt.NDArray[np.float32]
    intrinsics: Intrinsics
    serial: str | None
    q: Array
    T_base_tcp: Array
    detection: Detection

    @property
    def T_base_flange(self) -> Array:  # noqa: N802 (notation of the field)
        """(4, 4): from the arm's own tcp pose, which on hardware knows the arm's calibration."""
        return flange_pose(self.T_base_tcp)

    def picture(self) -> npt.NDArray[np.uint8]:
        """The image with the corners that were found."""
        return draw(self.color, self.detection)


def capture_view(cell: Cell, detector: Detector) -> Capture:
    """Wait until the arm is at rest, and take one view.

    A capture during which arm or board moved is refused as one without a board is: in its `detection`.

    Raises:
        DeviceFault: the arm does not come to rest.
        ConnectionLost, DeviceFault: as arm and camera do.
    """
    wait_for_standstill(cell)
    # An arm at rest trembles a little: the mean pose of the moments of the images belongs to their mean.
    frames, states = [], []
    for _ in range(FRAMES):
        frames.append(cell.camera.read())
        states.append(cell.arm.state())
    q = np.array([state.q for state in states])
    seen = [detector.detect(frame.color) for frame in frames]
    corners, wander_px = average([detection.corners for detection in seen])
    refused = detector.refuse(corners)
    if not refused and wander_px > _WANDER_PX:
        refused = f"the corners moved by {wander_px:.1f} px during the capture: is the board, or the camera, loose?"
    moved = float(np.ptp(q, axis=0).max())
    if moved > _STILL_RAD:
        refused = f"a joint moved by {1000 * moved:.1f} mrad during the capture"
    depths = np.stack([frame.depth_m for frame in frames])
    depths[depths == 0] = np.nan
    return Capture(
        t=frames[-1].t,
        color=np.rint(np.mean([frame.color for frame in frames], axis=0)).astype(np.uint8),
        depth_m=_median(depths),
        intrinsics=frames[-1].intrinsics,
        serial=frames[-1].serial,
        q=q.mean(axis=0),
        T_base_tcp=_mean([state.T_base_tcp for state in states]),
        detection=Detection(corners, refused),
    )


def wait_for_standstill(cell: Cell) -> ArmState:
    """The arm's state once it has been at rest for a moment.

    Raises:
        DeviceFault: it moves on and on.
    """
    state = cell.arm.state()
    start = since = cell.clock.now()
    while True:
        cell.clock.sleep(_PERIOD_S)
        now, newest = cell.clock.now(), cell.arm.state()
        if np.abs(newest.qd).max() > _STILL_RAD_S or np.abs(newest.q - state.q).max() > _STILL_RAD:
            state, since = newest, now
        if now - since >= _STILL_S:
            return newest
        if now - start > _PATIENCE_S:
            raise DeviceFault(
                f"the arm does not come to rest within {_PATIENCE_S:.0f} s: hold it still, then try again"
            )


def _mean(poses: list[Array]) -> Array:
    """The mean (4, 4) of poses that hardly differ."""
    stack = np.stack(poses)
    return make_transform(Rotation.from_matrix(stack[:, :3, :3]).mean().as_matrix(), stack[:, :3, 3].mean(axis=0))


def _median(depths: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Median (H, W) of (N, H, W) depths without the NaN among them; 0 where there is nothing else."""
    ordered = np.sort(depths, axis=0)  # NaN last
    count = np.isfinite(ordered).sum(axis=0)
    low, high = np.maximum(count - 1, 0) // 2, count // 2
    middle = 0.5 * (
        np.take_along_axis(ordered, low[None], axis=0)[0]
        + np.take_along_axis(ordered, np.minimum(high, len(depths) - 1)[None], axis=0)[0]
    )
    return np.where(count > 0, middle, 0).astype(np.float32)
