"""What a job refuses to start with, in the twin, and how that is told and recorded."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from robotcell.cell import Cell, open_cell
from robotcell.config import CellConfig, load_config
from robotcell.errors import CalibrationError, CellError, DeviceFault, StorageError
from robotcell.findings import Finding, Grade
from robotcell.interfaces import ArmMode
from robotcell.jobs.job import run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.preflight import Preflight, preflight
from robotcell.perception.picture_quality import blur, brightness

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robotcell.interfaces import RgbdFrame
    from robotcell.jobs.policy_api import Action, Observation


class Refuses:
    """A policy that is never asked."""

    name = "never asked"

    def __init__(self, config: CellConfig) -> None:
        self.workspace = config.workspace

    def decide(self, observation: Observation) -> Action:
        pytest.fail("the job has started")


class Wrapped:
    """A device with some of its calls replaced."""

    def __init__(self, device: Any, **calls: Any) -> None:
        self._device, self._calls = device, calls

    def __getattr__(self, name: str) -> Any:
        return self._calls.get(name, getattr(self._device, name))


@dataclass
class Opened:
    cell: Cell
    journal: Journal

    @property
    def config(self) -> CellConfig:
        return self.cell.config

    def look(self, **devices: Any) -> Preflight:
        """The preflight of the cell, some of its devices wrapped, or its configuration changed."""
        config = devices.pop("config", self.config)
        cell = replace(self.cell, config=config, devices=replace(self.cell.devices, **devices))
        return preflight(cell, self.journal, config.workspace)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Opened]:
    runs = tmp_path_factory.mktemp("runs")
    config = load_config(None, {"backend.options.objects": 4, "journal.runs": str(runs)})
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        yield Opened(cell, journal)


def wrong(found: Preflight) -> dict[str, Finding]:
    return {f"{finding.device}, {finding.what}": finding for finding in found.wrong}


def test_a_cell_that_is_well_may_start_and_the_job_begins_with_its_view(opened: Opened) -> None:
    q, width = opened.cell.arm.state().q, opened.cell.gripper.state().width_m
    found = opened.look()
    assert found.refusal() is None
    assert {finding.grade for finding in found.findings} == {Grade.OK}
    assert {finding.device for finding in found.findings} == {"arm", "gripper", "camera", "table", "bin", "storage"}
    assert found.view is not None
    assert found.view.segmentation.instances
    np.testing.assert_allclose(opened.cell.arm.state().q, q, atol=1e-3)
    assert opened.cell.gripper.state().width_m == pytest.approx(width, abs=1e-3)
    # The default camera looks past the bin, and that is said.
    (filling,) = [finding for finding in found.findings if finding.what == "filling"]
    assert "not known" in filling.value


def test_everything_that_is_wrong_is_told_at_once(opened: Opened, tmp_path: Path) -> None:
    arm = Wrapped(opened.cell.arm, state=lambda: replace(opened.cell.arm.state(), mode=ArmMode.PROTECTIVE_STOP))
    gripper = Wrapped(opened.cell.gripper, state=lambda: replace(opened.cell.gripper.state(), busy=True))
    (tmp_path / "file").write_text("")
    config = opened.config.model_copy(
        update={"journal": opened.config.journal.model_copy(update={"runs": tmp_path / "file"})}
    )
    found = opened.look(arm=arm, gripper=gripper, config=config)
    assert set(wrong(found)) == {"arm, mode", "gripper, fingers", "storage, folder of the runs"}
    refusal = found.refusal()
    assert isinstance(refusal, DeviceFault)
    for words in ("protective stop", "moving", "takes no file", "nothing moved"):
        assert words in str(refusal)


def test_a_device_that_cannot_be_asked_is_a_finding_and_the_others_are_looked_at(opened: Opened) -> None:
    def lost() -> None:
        raise DeviceFault("the box does not answer: check its cable", device="gripper")

    found = opened.look(gripper=Wrapped(opened.cell.gripper, state=lost))
    assert set(wrong(found)) == {"gripper, reach"}
    refusal = found.refusal()
    assert refusal is not None
    assert refusal.device == "gripper"
    assert found.view is not None


def test_what_the_arm_reports_of_itself_is_among_it(opened: Opened) -> None:
    changed = Finding("arm", "payload [kg]", "2.3", Grade.WRONG, "somebody has changed it")
    found = opened.look(arm=Wrapped(opened.cell.arm, report=lambda: (changed,)))
    assert changed in found.wrong
    slow = replace(changed, what="speed slider", grade=Grade.NOTE)
    assert opened.look(arm=Wrapped(opened.cell.arm, report=lambda: (slow,))).refusal() is None


def test_what_the_fingers_hold_is_noted(opened: Opened) -> None:
    holding = Wrapped(
        opened.cell.gripper, state=lambda: replace(opened.cell.gripper.state(), grip_detected=True, width_m=0.048)
    )
    notes = [finding for finding in opened.look(gripper=holding).findings if finding.grade is Grade.NOTE]
    assert [(note.device, note.value) for note in notes] == [("gripper", "48.0 mm open, holding something")]


def test_a_latched_stop_refuses_the_job(opened: Opened) -> None:
    opened.cell.latch.trip("the tool feels 120 N")
    try:
        refusal = opened.look().refusal()
    finally:
        opened.cell.latch.clear()
    assert refusal is not None
    assert refusal.code == "guard-tripped"
    assert "120 N" in str(refusal)


def picture(opened: Opened, change: Any) -> dict[str, Finding]:
    """Findings by what, of a cell whose camera delivers other frames."""
    found = opened.look(camera=Wrapped(opened.cell.camera, read=lambda: change(opened.cell.camera.read())))
    return {finding.what: finding for finding in found.findings}


def test_pictures_that_are_dark_or_blurred_are_noted(opened: Opened) -> None:
    def dark(frame: RgbdFrame) -> RgbdFrame:
        return replace(frame, color=(frame.color // 10).astype(np.uint8))

    def blurred(frame: RgbdFrame) -> RgbdFrame:
        return replace(frame, color=cv2.GaussianBlur(frame.color, (0, 0), 3))

    assert "light" in picture(opened, dark)["picture"].cure
    assert "clean the glass" in picture(opened, blurred)["picture"].cure
    sharp = opened.cell.camera.read().color
    assert blur(sharp) < 0.3 < blur(cv2.GaussianBlur(sharp, (0, 0), 2))
    assert brightness(np.full((4, 4, 3), 255, np.uint8)) == 1.0


def test_old_frames_and_holes_refuse_the_job(opened: Opened) -> None:
    def old(frame: RgbdFrame) -> RgbdFrame:
        return replace(frame, t=frame.t - 5.0)

    def holes(frame: RgbdFrame) -> RgbdFrame:
        depth = frame.depth_m.copy()
        depth[:, 100:] = 0.0
        return replace(frame, depth_m=depth)

    assert "5.0" in picture(opened, old)["reach"].cure
    assert "sees" in picture(opened, holes)["coverage"].cure


def test_a_bin_that_the_camera_sees_is_looked_into(opened: Opened) -> None:
    config = opened.config
    # As if the bin stood within the view.
    seen = config.model_copy(
        update={"bin": config.bin.model_copy(update={"center": (-0.5, 0.0), "size": (0.16, 0.16)})}
    )

    def filling(raised_m: float) -> Finding:
        def heap(frame: RgbdFrame) -> RgbdFrame:
            depth = frame.depth_m.copy()
            middle = depth[140:340, 220:420]
            middle[middle > 0] -= np.float32(raised_m)
            return replace(frame, depth_m=depth)

        camera = Wrapped(opened.cell.camera, read=lambda: heap(opened.cell.camera.read()))
        found = opened.look(camera=camera, config=seen)
        return next(finding for finding in found.findings if finding.what == "filling")

    assert filling(0.0).grade is Grade.OK
    full = filling(0.13)
    assert full.grade is Grade.WRONG
    assert "empty it" in full.cure


def test_a_camera_that_was_moved_is_a_matter_of_its_calibration(tmp_path: Path) -> None:
    offset = [0.0, 0.0, 0.03, 0.0, 0.0, 0.0]
    settings = {"backend.options.camera_offset": offset, "journal.runs": str(tmp_path / "runs")}
    config = load_config(None, settings)
    with Journal(config.journal.database_url()) as journal, open_cell(config) as cell:
        with pytest.raises(CalibrationError, match=r"nothing moved.*\n.*table appears tilted") as refused:
            run_job(cell, Refuses(config), journal, None)
        (job,) = journal.jobs()
        assert (job.status, job.reason) == ("refused", str(refused.value))
        assert journal.job(job.id).actions == []
        assert journal.metrics(job.id).actions == 0
        (folder,) = [path for path in (tmp_path / "runs").iterdir() if path.is_dir()]
        rows = json.loads((folder / "preflight.json").read_text())
        assert [row["device"] for row in rows if row["grade"] == "wrong"] == ["calibration"]


def test_a_calibration_of_another_camera_is_refused(tmp_path: Path) -> None:
    settings = {"camera.calibration": "examples/twin-calibration.json", "journal.runs": str(tmp_path)}
    config = load_config(None, settings)
    measured = config.camera.measured
    assert measured is not None
    with open_cell(config) as cell, Journal("sqlite://") as journal:
        found = preflight(cell, journal, config.workspace)
        known = {finding.what: finding for finding in found.findings if finding.device == "calibration"}
        assert known["intrinsics"].grade is Grade.OK

        def other(frame: RgbdFrame) -> RgbdFrame:
            focal = replace(frame.intrinsics, fx=1.05 * frame.intrinsics.fx)
            return replace(frame, serial="000000000000", intrinsics=focal)

        opened = Opened(cell, journal)
        assert {"camera", "intrinsics"} <= {
            what for what, finding in picture(opened, other).items() if finding.grade is Grade.WRONG
        }


def test_a_journal_that_takes_no_row_is_told_with_the_rest(opened: Opened, tmp_path: Path) -> None:
    class Full:
        def check_writable(self) -> None:
            raise StorageError("the journal cannot be written: disk I/O error; check disk and database")

    found = preflight(opened.cell, Full(), opened.config.workspace)  # type: ignore[arg-type]
    assert set(wrong(found)) == {"storage, journal"}
    assert isinstance(found.refusal(), StorageError)
    # Where a refusal cannot be recorded, it is told all the same.
    (tmp_path / "file").write_text("")
    runs = {"journal": opened.config.journal.model_copy(update={"runs": tmp_path / "file"})}
    cell = replace(opened.cell, config=opened.config.model_copy(update=runs))
    with pytest.raises(CellError, match="takes no file"):
        run_job(cell, Refuses(cell.config), opened.journal, None)
