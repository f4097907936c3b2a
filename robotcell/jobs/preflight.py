"""What is looked at before a job moves anything: everything that is wrong at once, each with its cure."""

from __future__ import annotations

import json
import shutil
import tempfile
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np

from robotcell.config.schema import Workspace
from robotcell.errors import CellError, DeviceFault, GuardTripped, StorageError, UnsafeMotion
from robotcell.findings import Finding, Grade, collect
from robotcell.interfaces import ArmMode
from robotcell.io.atomic_file import write_whole
from robotcell.motion.grasp import release_corners
from robotcell.motion.tool import solve_tool_down, tool_down
from robotcell.perception.heightmap import build_heightmap, upper_height
from robotcell.perception.picture_quality import blur, brightness
from robotcell.perception.view import View, examine, fresh_frame, view_blocked

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.interfaces import RgbdFrame
    from robotcell.jobs.journal import Journal

# A run writes about 2 MB an action. A disk with less than the first is as good as full: the database needs some too.
_LITTLE_SPACE_BYTES, _SCARCE_SPACE_BYTES = 100e6, 1e9
# Mean grey level below which colours cannot be told, and above which they are washed out. Assumed.
_DARK, _BRIGHT = 0.06, 0.94
# A clean picture of a table has 0.1 to 0.2, one that is blurred by 2 px or more over 0.55 (measured in the twin).
_BLURRED = 0.5
# A camera reports the intrinsics that its calibration took over within these, unless it is another one.
_SAME_FOCAL, _SAME_CENTER_PX = 0.001, 0.5
# Refined intrinsics of a D415 differ from its own by up to this. Assumed.
_REFINED_FOCAL, _REFINED_CENTER_PX = 0.03, 15.0
# The bin's walls, and what the map smears at their rims, are left out.
_WALL_M = 0.02
_BIN_CELL_M = 0.005
# Of the bin's floor so much must be seen to say anything of what lies in it. Assumed.
_BIN_SEEN = 0.3
# The tips let go 120 mm over the rim, and a load reaches 60 mm below them: what stands higher than this over the rim
# is in the way. A heap up to the rim sheds what is dropped on it.
_OVER_RIM_M, _UNDER_RIM_M = 0.03, 0.01
_TOP_PERCENT = 98


@dataclass(frozen=True)
class Preflight:
    """What was found before a job.

    Attributes:
        findings: everything that was looked at.
        view: of the table, for the job to begin with; None where the arm stood in the view, or the camera saw too
            little.
    """

    findings: tuple[Finding, ...]
    view: View | None

    @property
    def wrong(self) -> list[Finding]:
        """What a job must not start with."""
        return [finding for finding in self.findings if finding.grade is Grade.WRONG]

    def refusal(self) -> CellError | None:
        """The error with which a job is refused; None where it may start."""
        wrong = self.wrong
        if not wrong:
            return None
        codes, devices = {finding.code for finding in wrong}, {finding.device for finding in wrong}
        kinds = {kind.code: kind for kind in CellError.__subclasses__()}
        kind = kinds[codes.pop()] if len(codes) == 1 else DeviceFault
        lines = [f"{finding.device}, {finding.what}: {finding.value}: {finding.cure}" for finding in wrong]
        error = kind("\n  ".join(["the job is not started; nothing moved:", *lines]))
        for name in ("arm", "gripper", "camera"):
            if devices == {name}:
                error.device = name
        return error

    def save(self, folder: Path) -> None:
        """Write all findings to `preflight.json` in a folder.

        Raises:
            StorageError: it cannot be written.
        """
        rows = [{**vars(finding), "grade": finding.grade.value} for finding in self.findings]
        write_whole(folder / "preflight.json", json.dumps(rows, indent=1) + "\n")


def preflight(cell: Cell, journal: Journal, workspace: Workspace) -> Preflight:
    """Look at everything that a job needs. Nothing moves.

    Args:
        cell: connected.
        journal: of the job.
        workspace: the map that the job's policy declares.
    """
    config = cell.config
    findings = [
        *collect("arm", lambda: _arm(cell)),
        *collect("gripper", lambda: _gripper(cell)),
        *collect("bin", lambda: _bin_in_reach(config)),
        *_storage(config, journal),
    ]
    views: list[View] = []
    findings += collect("camera", lambda: _camera(cell, workspace, views))
    return Preflight(tuple(findings), views[0] if views else None)


def _arm(cell: Cell) -> Iterator[Finding]:
    latched = cell.latch.violation
    if latched:
        cure = "look at the cell, then run robotcell recover"
        yield Finding("arm", "safety stop", latched, Grade.WRONG, cure, GuardTripped.code)
    state, now, limits = cell.arm.state(), cell.clock.now(), cell.config.limits
    ready = state.mode is ArmMode.READY
    cure = "" if ready else "clear the cause at the cell, then run robotcell recover"
    yield Finding("arm", "mode", state.mode.value, Grade.OK if ready else Grade.WRONG, cure)
    age = now - state.t
    old = not age <= limits.state_age_s
    cure = f"at most {limits.state_age_s:g} s are allowed: see robotcell doctor for the link" if old else ""
    yield Finding("arm", "state", f"{1000 * max(age, 0.0):.0f} ms old", Grade.WRONG if old else Grade.OK, cure)
    if cell.arm.moving:
        yield Finding("arm", "motion", "under way", Grade.WRONG, "wait until it has ended, or stop it")
    # What it reports of itself matters once it can be driven at all.
    if ready:
        yield from cell.arm.report()


def _gripper(cell: Cell) -> Iterator[Finding]:
    state = cell.gripper.state()
    width = f"{1000 * state.width_m:.1f} mm open"
    if state.busy:
        yield Finding("gripper", "fingers", f"{width}, moving", Grade.WRONG, "wait until they rest, or stop them")
    elif state.grip_detected:
        cure = "what they hold falls when the job opens them: take it out first if it must not"
        yield Finding("gripper", "fingers", f"{width}, holding something", Grade.NOTE, cure)
    else:
        yield Finding("gripper", "fingers", f"{width}, empty")


def _bin_in_reach(config: CellConfig) -> Iterator[Finding]:
    missed = []
    for x, y, z in release_corners(config):
        try:
            solve_tool_down(f"over the bin at x {x:.3f}, y {y:.3f} m", tool_down(x, y, z, 0.0), config)
        except UnsafeMotion as error:
            missed.append(str(error))
    reached = "in reach" if not missed else "out of reach"
    cure = f"{missed[0]}; move the bin, or correct bin.center" if missed else ""
    yield Finding("bin", "place", reached, Grade.WRONG if missed else Grade.OK, cure, UnsafeMotion.code)


def _storage(config: CellConfig, journal: Journal) -> Iterator[Finding]:
    runs = config.journal.runs
    try:
        runs.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=runs) as file:
            file.write(b"\0")
        free = shutil.disk_usage(runs).free
    except OSError as error:
        cure = f"{error.strerror}: correct journal.runs, or make room"
        yield Finding("storage", "folder of the runs", f"{runs} takes no file", Grade.WRONG, cure, StorageError.code)
    else:
        grade = Grade.OK
        if free < _SCARCE_SPACE_BYTES:
            grade = Grade.WRONG if free < _LITTLE_SPACE_BYTES else Grade.NOTE
        cure = "" if grade is Grade.OK else f"make room where {runs} is; a run writes about 2 MB an action"
        yield Finding("storage", "disk", f"{free / 1e9:.1f} GB free", grade, cure, StorageError.code)
    try:
        journal.check_writable()
    except StorageError as error:
        yield Finding("storage", "journal", "takes no row", Grade.WRONG, str(error), error.code)
    else:
        yield Finding("storage", "journal", "writable")


def _camera(cell: Cell, workspace: Workspace, views: list[View]) -> Iterator[Finding]:
    """What the camera shows; the view of the table is put into `views` where it can be used."""
    config = cell.config
    frame = fresh_frame(cell.devices, config)
    age = cell.clock.now() - frame.t
    yield Finding("camera", "frame", f"number {frame.number}, {1000 * max(age, 0.0):.0f} ms old")
    yield _picture(frame)
    yield from _calibration(frame, config)
    if view_blocked(cell.devices, config, workspace):
        yield Finding("camera", "table", "behind the arm; looked at once it is at home")
        return
    view, problems = examine(frame, config, cell.arm.state().q, workspace)
    for problem in problems:
        of_camera = isinstance(problem, DeviceFault)
        device, what = ("camera", "coverage") if of_camera else ("calibration", "drift")
        yield Finding(device, what, "too little" if of_camera else "found", Grade.WRONG, str(problem), problem.code)
    if problems:
        return
    views.append(view)
    seen, table = float(np.isfinite(view.heightmap.closed_m).mean()), view.heightmap.table
    yield Finding("camera", "coverage", f"{seen:.0%} of the workspace seen")
    if table is not None:
        tilt, offset = np.degrees(table.tilt_rad), 1000 * table.offset_m
        yield Finding("table", "plane", f"tilted by {tilt:.2f} degrees, {offset:+.1f} mm off")
    yield _bin_filling(view, config)


def _picture(frame: RgbdFrame) -> Finding:
    light, blurred = brightness(frame.color), blur(frame.color)
    value = f"brightness {light:.0%}, blur {blurred:.0%}"
    if not _DARK < light < _BRIGHT:
        return Finding("camera", "picture", value, Grade.NOTE, "colours cannot be told in it: correct the light")
    if blurred > _BLURRED:
        cure = "it is blurred: clean the glass before the lens, and keep the camera still"
        return Finding("camera", "picture", value, Grade.NOTE, cure)
    return Finding("camera", "picture", value)


def _calibration(frame: RgbdFrame, config: CellConfig) -> Iterator[Finding]:
    measured = config.camera.measured
    if measured is None:
        return
    age = datetime.now(timezone.utc) - measured.date
    yield Finding("calibration", "file", f"{config.camera.calibration}, {age.days} days old")
    said, seen = measured.camera, frame.intrinsics
    if said.serial is not None and frame.serial is not None and said.serial != frame.serial:
        cure = f"it is of the camera {said.serial}, and {frame.serial} is in use: calibrate again"
        yield Finding("calibration", "camera", "another one", Grade.WRONG, cure, "calibration")
    refined = measured.intrinsics_refined
    focal, center = (_REFINED_FOCAL, _REFINED_CENTER_PX) if refined else (_SAME_FOCAL, _SAME_CENTER_PX)
    off_focal = max(abs(said.fx / seen.fx - 1), abs(said.fy / seen.fy - 1))
    off_center = max(abs(said.cx - seen.cx), abs(said.cy - seen.cy))
    value = f"focal lengths within {off_focal:.2%}, centre within {off_center:.1f} px"
    if off_focal > focal or off_center > center:
        cure = f"the camera's own differ from the file's by more than {focal:.1%} or {center:g} px: calibrate again"
        yield Finding("calibration", "intrinsics", value, Grade.WRONG, cure, "calibration")
    else:
        yield Finding("calibration", "intrinsics", value)


def _bin_filling(view: View, config: CellConfig) -> Finding:
    """How full the bin is, as far as the camera sees into it."""
    (x, y), (width, depth) = config.bin.center, config.bin.size
    half_x, half_y = width / 2 - _WALL_M, depth / 2 - _WALL_M
    inside = Workspace(x=(x - half_x, x + half_x), y=(y - half_y, y + half_y), resolution_m=_BIN_CELL_M)
    heights = build_heightmap(view.frame, view.camera, inside, config.table.height_m).closed_m
    seen = heights[np.isfinite(heights)]
    if seen.size < _BIN_SEEN * heights.size:
        return Finding("bin", "filling", f"not known: the camera sees {seen.size / heights.size:.0%} of its inside")
    rim = config.bin.wall_height_m
    top, usual = upper_height(seen, _TOP_PERCENT), float(np.median(seen))
    value = f"{1000 * usual:.0f} mm in the middle, at most {1000 * top:.0f} of {1000 * rim:.0f} mm"
    if top > rim + _OVER_RIM_M or usual > rim - _UNDER_RIM_M:
        return Finding("bin", "filling", value, Grade.WRONG, "empty it: what is dropped would not stay in it")
    return Finding("bin", "filling", value)
