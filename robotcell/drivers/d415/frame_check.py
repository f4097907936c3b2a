"""Whether a frame is to be used: new, whole, of one moment, and of a scene that can be seen."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from robotcell.drivers.d415.realsense import USB_ADVICE, load_pyrealsense2
from robotcell.errors import DeviceFault

if TYPE_CHECKING:
    import numpy.typing as npt

    from robotcell.interfaces import Clock

FRAMES_PER_S = 30

# Exposure, read-out and transfer of a frame: by how much it is older than its arrival, where the camera does not say.
_TRANSFER_S = 0.05
# Depth and colour of one moment; more than a period apart they are of two.
_SAME_MOMENT_S = 1 / FRAMES_PER_S
# Of pixels with depth, and mean count of 255: an image below is of a covered or broken camera, or of no light at all.
_MIN_DEPTH_SHARE = 0.01
_MIN_BRIGHTNESS = 5.0


class FrameCheck:
    """Checks the frames of one stream in their order.

    Args:
        clock: of the cell.
        recorded: the stream is a recorded file, which begins again at its end and whose time stamps are of the past.
    """

    def __init__(self, clock: Clock, *, recorded: bool) -> None:
        self._clock = clock
        self._recorded = recorded
        self._last_number = -1
        # Frames of earlier rounds of a recorded file.
        self._earlier_numbers = 0

    def skip(self, frameset: Any) -> None:
        """Take note of a frame that is not used."""
        self._last_number = frameset.get_frame_number()

    def check(self, frameset: Any, called: float) -> tuple[float, int]:
        """Time of capture on the cell's clock [s] and number of a frameset that is asked for at the time `called` [s].

        Raises:
            DeviceFault: it is stale, repeated, not whole, or of two moments.
        """
        depth, color = frameset.get_depth_frame(), frameset.get_color_frame()
        if not depth or not color:
            raise _fault(f"frames come without {'colour' if depth else 'depth'}; {USB_ADVICE}")
        # Two streams that do not match come in turn, each with the last frame of the other.
        apart_s = abs(depth.get_timestamp() - color.get_timestamp()) / 1000
        if apart_s > _SAME_MOMENT_S:
            raise _fault(
                f"colour and depth are {apart_s:.2f} s apart: one of the streams lags or stands still; connect again"
            )
        number = depth.get_frame_number() + self._earlier_numbers
        if number <= self._last_number:
            if not self._recorded:
                raise _fault(f"it repeats frame {number}: its stream is frozen; plug it in again")
            # The recording has begun again.
            self._earlier_numbers += self._last_number + 1 - number
            number = self._last_number + 1
        self._last_number = number
        t = min(self._time_of(depth), self._time_of(color))
        if t < called:
            raise _fault(
                f"the newest frame is {self._clock.now() - t:.2f} s old: frames come late; is the machine, or the USB "
                "port, overloaded?"
            )
        return t, number

    def _time_of(self, frame: Any) -> float:
        """Time of capture on the cell's clock [s]; where the camera does not tell, not later than it can be."""
        rs, now = load_pyrealsense2(), self._clock.now()
        if self._recorded:
            return now
        domain = frame.get_frame_timestamp_domain()
        if domain == rs.timestamp_domain.hardware_clock:
            return now - _TRANSFER_S
        age_s = max(0.0, time.time() - float(frame.get_timestamp()) / 1000)
        return now - age_s - (0.0 if domain == rs.timestamp_domain.global_time else _TRANSFER_S)


def check_images(color: npt.NDArray[np.uint8], depth_m: npt.NDArray[np.float32]) -> None:
    """Refuse images in which nothing can be seen.

    Raises:
        DeviceFault: next to no pixel has depth, or colour is black.
    """
    if np.count_nonzero(depth_m) < _MIN_DEPTH_SHARE * depth_m.size:
        raise _fault(
            "nothing in the image has depth; is a lens covered, or is something nearer than 0.3 m (0.45 m at 1280x720)?"
        )
    if color[::8, ::8].mean() < _MIN_BRIGHTNESS:
        raise _fault("the colour image is black; is the lens covered, or the light off?")


def _fault(what: str) -> DeviceFault:
    return DeviceFault(f"camera: {what}", device="camera")
