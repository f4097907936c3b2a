"""The tables of `cell.toml`. Lengths in metres, angles in radians, base frame."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, PrivateAttr, model_validator

from robotcell.config.calibration_file import CameraCalibration, load_calibration
from robotcell.geometry import rg2
from robotcell.geometry.transforms import Array, check_transform, look_at


def _ordered(interval: tuple[float, float]) -> tuple[float, float]:
    if not interval[0] < interval[1]:
        raise ValueError("the first number must be below the second")
    return interval


Interval = Annotated[tuple[float, float], AfterValidator(_ordered)]
Positive = Annotated[float, Field(gt=0)]
Vector3 = tuple[float, float, float]


class _Table(BaseModel):
    """A table of cell.toml: unknown keys are refused, numbers are finite, nothing changes after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Workspace(_Table):
    """The rectangle of the table that the heightmap covers.

    Rows run along base y, columns along base x; the centre of cell (row, col) is at
    x = x_min + (col + 0.5) resolution, y = y_min + (row + 0.5) resolution.
    """

    # The rectangle of the table that is worked on, along x of the base.
    x: Interval = (-0.724, -0.276)
    # The same along y.
    y: Interval = (-0.224, 0.224)
    # Side of a cell of the heightmap that `Cell.look` builds. A policy brings a map of its own.
    resolution_m: Annotated[float, Field(ge=0.0005, le=0.01)] = 0.002

    @property
    def shape(self) -> tuple[int, int]:
        """(rows, columns) of the heightmap."""
        rows, cols = ((b - a) / self.resolution_m for a, b in (self.y, self.x))
        return max(1, round(rows)), max(1, round(cols))

    def position(self, row: float, col: float) -> tuple[float, float]:
        """(x, y) [m] of the centre of a cell."""
        return self.x[0] + (col + 0.5) * self.resolution_m, self.y[0] + (row + 0.5) * self.resolution_m

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, col) of the cell that contains a point [m]; outside the heightmap if the point is."""
        return (
            int(np.floor((y - self.y[0]) / self.resolution_m)),
            int(np.floor((x - self.x[0]) / self.resolution_m)),
        )


class Table(_Table):
    """The table top: the plane z = height_m."""

    # z of the table top.
    height_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0


class Bin(_Table):
    """The box that picked objects are dropped into."""

    # x and y of the middle of the bin.
    center: tuple[float, float] = (-0.30, 0.45)
    # Its outer sides along x and y.
    size: tuple[Positive, Positive] = (0.36, 0.30)
    # Height of its walls above the table.
    wall_height_m: Annotated[float, Field(gt=0, le=0.5)] = 0.12


class KeepOut(_Table):
    """A box that no part of arm, gripper or load may enter."""

    # What errors call it.
    name: str
    # Its extent along x of the base.
    x: Interval
    # Its extent along y of the base.
    y: Interval
    # Its extent along z of the base.
    z: Interval

    def corners(self) -> tuple[Array, Array]:
        """The lowest and the highest corner (3,), base frame [m]."""
        low, high = np.array([self.x, self.y, self.z]).T
        return low, high


class Motion(_Table):
    """How the arm moves. Speeds are those of the leading joint and of the tcp."""

    # Joint angles of the pose from which the camera sees the whole workspace. By default the tool stands upright
    # beside the workspace, next to the bin: arm and gripper are 0.1 m out of the view.
    home_q: tuple[float, float, float, float, float, float] = (-0.8370, -1.4768, 1.2793, -1.3733, -1.5708, 0.7338)
    # Speed of the leading joint.
    joint_speed_rad_s: Annotated[float, Field(gt=0, le=3.14)] = 1.5
    # Acceleration of the leading joint; the default is Universal Robots' own for movej.
    joint_acceleration_rad_s2: Annotated[float, Field(gt=0, le=40)] = 1.4
    # Speed of the tcp on straight lines.
    linear_speed_m_s: Annotated[float, Field(gt=0, le=1)] = 0.4
    # Acceleration of the tcp on straight lines; the default is Universal Robots' own for movel.
    linear_acceleration_m_s2: Annotated[float, Field(gt=0, le=10)] = 1.2
    # Share of its speed at which every motion is run: the same way, and as much more time for it. Accelerations are
    # lowered by its square. `robotcell pick --speed` sets it.
    speed_fraction: Annotated[float, Field(ge=0.05, le=1)] = 1.0
    # Speed of the last part of a descent, and of a push. A finger that lands on a block is stopped at 30 to 85 N
    # (measured in the twin; 90 N at 0.10, 75 N at 0.06).
    guarded_speed_m_s: Annotated[float, Field(gt=0, le=0.25)] = 0.08
    # Height of the approach above the end of a descent.
    approach_m: Annotated[float, Field(ge=0.02, le=0.4)] = 0.15
    # Length of a push.
    push_m: Annotated[float, Field(ge=0.01, le=0.3)] = 0.10
    # A guarded descent that meets this force has met an object: it ends, and the grasp is given up.
    contact_force_n: Annotated[float, Field(gt=0, le=100)] = 30.0
    # Finger tips sweep down by up to 15 mm as they close. Where that presses harder than this on what lies beneath,
    # they open again, and the grasp is given up. Grasps that held pressed with 3 to 45 N, one of 26 with 65 N and one
    # with 81 N (measured in the twin).
    closing_force_n: Annotated[float, Field(gt=0, le=250)] = 70.0


class Limits(_Table):
    """What the safety layer allows. It adds to the controller's own safety settings and never replaces them."""

    # The tcp stays inside a box (the workspace, the bin and the way between them): its extent along x of the base.
    x: Interval = (-0.80, 0.20)
    # The box along y of the base.
    y: Interval = (-0.45, 0.65)
    # The box in height above the table.
    z: Interval = (0.0, 0.70)
    # Distance that every joint keeps from its limit.
    joint_margin_rad: Annotated[float, Field(ge=0, le=1)] = 0.05
    # A plan with a faster joint is refused; an arm with a joint 5 % faster is stopped.
    joint_speed_rad_s: Annotated[float, Field(gt=0, le=3.14)] = 2.0
    # The same for the tool.
    tool_speed_m_s: Annotated[float, Field(gt=0, le=3)] = 1.5
    # A force on the tool that stops the cell during a guarded motion, which ends by itself at motion.contact_force_n,
    # and while something is carried: loads that are not held firmly strike the fingers with up to 72 N (novel objects,
    # measured in the twin). The default is below the 150 N at which a UR5e's factory safety preset stops the arm.
    force_n: Annotated[float, Field(gt=0, le=250)] = 100.0
    # The same in free motions, where nothing is to be touched, if it is lower. Those of the twin feel nothing; what a
    # UR5e reports of a tool in free air scatters by some newtons. Half of it for 0.3 s stops the cell too.
    free_force_n: Annotated[float, Field(gt=0, le=250)] = 50.0
    # The same while the fingers move, which open by themselves at motion.closing_force_n. Below the controller's 150 N.
    grip_force_n: Annotated[float, Field(gt=0, le=250)] = 140.0
    # Smallest singular value of the Jacobian on straight lines.
    singularity: Annotated[float, Field(ge=0, le=0.2)] = 0.02
    # Distance that arm and gripper keep from keep-outs and from themselves.
    clearance_m: Annotated[float, Field(ge=0, le=0.1)] = 0.005
    # An older state of the arm stops it.
    state_age_s: Annotated[float, Field(gt=0, le=1)] = 0.1
    # An older frame is refused.
    frame_age_s: Annotated[float, Field(gt=0, le=5)] = 1.0
    # Share of the workspace that the camera must see, gaps between pixels not counted as unseen.
    min_coverage: Annotated[float, Field(ge=0, le=1)] = 0.6
    # The measured table may be tilted by this.
    max_tilt_rad: Annotated[float, Field(gt=0, le=0.2)] = 0.02
    # The measured table may lie above or below `table.height_m` by this.
    max_table_offset_m: Annotated[float, Field(gt=0, le=0.05)] = 0.006


class CameraMount(_Table):
    """The fixed camera: its mode, and where it stands, by a calibration, by a transform or by two points."""

    # The mode of the camera: 640x480 or 1280x720. A calibration holds for one mode.
    resolution: Annotated[str, Field(pattern="^(640x480|1280x720)$")] = "640x480"
    # Where the camera stands. The default is 20 degrees off the vertical: the taller block of two hides little of the
    # lower one, and the post stands clear.
    position: Vector3 = (-0.80, 0.0, 0.80)
    # A point on the axis of the camera.
    look_at: Vector3 = (-0.5, 0.0, 0.0)
    # T_base_camera, rows of a 4x4 matrix (colour optical frame, OpenCV axes); stands above the two points.
    T_base_camera: tuple[tuple[float, ...], ...] | None = None
    # A file that robotcell calibrate wrote, its path relative to the cell's file. It stands above the two points, and
    # is refused beside T_base_camera. A twin's camera really stands where the points have it, and this file is what the
    # program believes.
    calibration: Path | None = None

    _measured: CameraCalibration | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _is_a_pose(self) -> CameraMount:
        if self.calibration is not None:
            if self.T_base_camera is not None:
                raise ValueError("calibration and T_base_camera both say where the camera stands; keep one")
            self._measured = load_calibration(self.calibration)
            if self._measured.mount != "fixed":
                raise ValueError(f"{self.calibration} is of a camera on the flange; the cell's camera is fixed")
        self.pose()
        return self

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the image [px]."""
        width, height = self.resolution.split("x")
        return int(width), int(height)

    @property
    def measured(self) -> CameraCalibration | None:
        """What the calibration file holds; None without one. Whether it fits the camera, its `check` says."""
        return self._measured

    def pose(self) -> Array:
        """T_base_camera (4, 4)."""
        return self.nominal() if self._measured is None else self._measured.pose()

    def nominal(self) -> Array:
        """T_base_camera (4, 4) without the calibration file: by the transform, or by the two points."""
        if self.T_base_camera is not None:
            return check_transform(self.T_base_camera, "T_base_camera")
        return look_at(self.position, self.look_at)


class GripperUse(_Table):
    """How the gripper is used."""

    # Force of a finger. With 40 N, fingers that close on novel objects press too hard on what lies beneath more often
    # than with 25 N (policy/data/MODEL_CARD.md); 25 N carries 1 kg at a friction of 0.2.
    force_n: Annotated[float, Field(ge=rg2.MIN_FORCE_N, le=rg2.MAX_FORCE_N)] = 25.0
    # Opening with which the fingers come down. It is narrower than the stroke: wide-open fingers collide with
    # neighbours, and their tips draw back by 40 mm.
    preshape_m: Annotated[float, Field(gt=0, le=rg2.MAX_WIDTH_M)] = 0.080
    # Fingers closer than this hold nothing.
    empty_width_m: Annotated[float, Field(gt=0, le=0.05)] = 0.005
    # The finger tips stay this far above the table.
    tip_clearance_m: Annotated[float, Field(ge=0.001, le=0.05)] = 0.003


class PolicyChoice(_Table):
    """Which policy decides."""

    # learned, heuristic, grasp-only, single-stage or random.
    name: str = "learned"


class JournalPlace(_Table):
    """Where jobs are recorded."""

    # Any SQLAlchemy URL; by default a SQLite file in the folder of the runs.
    url: str | None = None
    # Folder of the runs.
    runs: Path = Path("runs")

    @property
    def default_file(self) -> Path:
        """The SQLite file that is the journal when no URL is given."""
        return self.runs / "journal.db"

    def database_url(self) -> str | Path:
        """The SQLAlchemy URL of the journal, or the SQLite file where none is given: a path may hold any sign."""
        return self.url or self.default_file


class BackendChoice(_Table):
    """Which devices stand behind the interfaces; the backend itself checks its options."""

    # twin, hardware, or another entry point of the group robotcell.backends.
    name: str = "twin"
    # Settings of the backend, which it checks itself.
    options: dict[str, Any] = {}


class CellConfig(_Table):
    """A whole cell."""

    workspace: Workspace = Workspace()
    table: Table = Table()
    bin: Bin = Bin()
    keep_out: tuple[KeepOut, ...] = ()
    motion: Motion = Motion()
    limits: Limits = Limits()
    camera: CameraMount = CameraMount()
    gripper: GripperUse = GripperUse()
    policy: PolicyChoice = PolicyChoice()
    journal: JournalPlace = JournalPlace()
    backend: BackendChoice = BackendChoice()
