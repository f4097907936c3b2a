"""The twin's D415: renders what the camera would see of the world, and degrades it as the device does."""

from __future__ import annotations

from datetime import timedelta
from typing import TYPE_CHECKING

from robotcell.errors import ConnectionLost
from robotcell.interfaces import Camera, RgbdFrame
from sim_twin.d415.noise import WARM_UP_FRAMES
from sim_twin.d415.open3d_core import load_open3d
from sim_twin.d415.renderer import FRAMES_PER_S, SERIAL, Floats, Renderer
from sim_twin.world.simulation import STEP_S

if TYPE_CHECKING:
    from collections.abc import Callable

    from robotcell.config import CameraMount
    from sim_twin.d415.rays import Indices
    from sim_twin.options import TwinOptions
    from sim_twin.world.world import World

_STEPS_PER_FRAME = round(1 / (FRAMES_PER_S * STEP_S))


class TwinCamera(Camera):
    """A `Camera` that looks at a simulated world with the resolution, rate and errors of a D415.

    Frames come at 30 Hz of simulated time: `read()` lets the world run on by one frame. `connect()` lets the
    frames pass in which automatic exposure settles, as a driver of the device does. The frame number counts
    from the beginning of the world.

    Args:
        world: what there is to see.
        mount: resolution and place.
        options: which errors the device makes, and how far it stands from its place; the same seed at the same time
            gives the same frame.
    """

    def __init__(self, world: World, mount: CameraMount, options: TwinOptions) -> None:
        self._world = world
        self._mount = mount
        self._options = options
        self._first_frame: int | None = None
        self._renderer: Renderer | None = None

    def connect(self) -> None:
        """Start the stream and wait until its exposure has settled.

        Raises:
            ConfigError: open3d is not installed, or the world cannot be built.
            CalibrationError: the calibration is of another camera or another resolution.
        """
        if self._first_frame is not None:
            return
        if self._mount.measured is not None:
            # Nobody leans on a simulated camera: its calibration does not age.
            self._mount.measured.check(serial=SERIAL, resolution=self._mount.size, max_age=timedelta.max)
        load_open3d()
        self._world.attach(self)
        try:
            self._prepare()
            self._first_frame = self._frame_number()
            if self._options.noise.warm_up:
                self._world.step(WARM_UP_FRAMES * _STEPS_PER_FRAME)
        except BaseException:
            self._first_frame = None
            self._world.detach(self)
            raise

    def close(self) -> None:
        """Stop the stream."""
        if self._first_frame is not None:
            self._first_frame = None
            self._world.detach(self)
        self._renderer = None

    def read(self) -> RgbdFrame:
        """The next frame.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        return self.read_with_truth()[0]

    def read_with_truth(self) -> tuple[RgbdFrame, Indices]:
        """The next frame, and the index (H, W) into `world.visuals()` of what each pixel really shows, -1 = nothing.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        self._connected()
        self._world.step(_STEPS_PER_FRAME)
        return self._capture()()

    def poll(self, since: float) -> Callable[[], RgbdFrame] | None:
        """The frame of this moment, once one is due after `since`; see `Camera`.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        self._connected()
        if self._frame_number() <= round(since / STEP_S) // _STEPS_PER_FRAME:
            return None
        develop = self._capture()
        return lambda: develop()[0]

    def _capture(self) -> Callable[[], tuple[RgbdFrame, Indices]]:
        """What there is to see now; called, it gives the frame, and the index (H, W) of what each pixel shows."""
        first_frame, renderer = self._connected(), self._prepare()
        t, number, poses = self._world.time_s, self._frame_number(), self._world.visual_poses()

        def develop() -> tuple[RgbdFrame, Indices]:
            hits = renderer.cast(poses)
            frame = RgbdFrame(
                t=t,
                number=number,
                color=renderer.measured_color(renderer.color(hits), number, t, number - first_frame),
                depth_m=renderer.measured_depth(hits.depth_m, renderer.incidence_cos(hits), number),
                intrinsics=renderer.reported_intrinsics,
                serial=SERIAL,
            )
            return frame, hits.visual()

        return develop

    def render_truth(self) -> tuple[Floats, Indices]:
        """What is really in front of the camera now: for scores, labels and tests, never for a decision.

        Returns:
            Depth (H, W) [m] along the optical axis, 0 = nothing, and the index (H, W) into `world.visuals()`,
            -1 = nothing. No noise, no limit of range, and no time passes.

        Raises:
            ConnectionLost: the camera is not connected.
        """
        self._connected()
        hits = self._prepare().cast(self._world.visual_poses())
        return hits.depth_m, hits.visual()

    def _connected(self) -> int:
        if self._first_frame is None:
            raise ConnectionLost("the twin's camera is not connected; call connect() first")
        return self._first_frame

    def _frame_number(self) -> int:
        return round(self._world.time_s / STEP_S) // _STEPS_PER_FRAME

    def _prepare(self) -> Renderer:
        visuals = self._world.visuals()
        if self._renderer is None or visuals is not self._renderer.visuals:
            self._renderer = Renderer(visuals, self._mount, self._options)
        return self._renderer
