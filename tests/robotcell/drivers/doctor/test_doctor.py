"""The doctor: what it finds when nothing is there, when all is well, and when something is wrong; and `recover`."""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from robotcell.cell import open_cell
from robotcell.config import load_config
from robotcell.drivers.doctor.examine import examine
from robotcell.errors import ConfigError
from robotcell.findings import Finding, Grade
from robotcell.interfaces import ArmMode
from sim_twin.wire.faults import Kind
from tests.addresses import loopback
from tests.robotcell.drivers.served_cell import CAMERA_PORT, HOST, MODBUS_PORT
from tests.robotcell.drivers.ur5e.served_arm import fault, joints, make_arm, wait_until

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robotcell.config import CellConfig
    from sim_twin.wire.cell import ServedCell

SECONDS = 0.5


@pytest.fixture(autouse=True)
def _faultless(served: ServedCell) -> Iterator[None]:
    yield
    served.clear()


def cell_text(host: str) -> str:
    return (
        f'[backend]\nname = "hardware"\n[backend.options.arm]\nhost = "{host}"\n'
        f'[backend.options.gripper]\nhost = "{host}"\nport = {MODBUS_PORT}\n'
        f'[backend.options.camera]\nsource = "twin://{host}:{CAMERA_PORT}"\n'
    )


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    path = tmp_path / "cell.toml"
    path.write_text(f'{cell_text(HOST)}[journal]\nruns = "{tmp_path / "runs"}"\n')
    return path


@pytest.fixture
def config(cell_file: Path) -> CellConfig:
    return load_config(cell_file)


def wrong(findings: list[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.grade is Grade.WRONG]


def test_with_nothing_there_each_device_says_what_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "absent.toml"
    path.write_text(cell_text(loopback(49)))
    begin = time.monotonic()
    result = CliRunner().invoke(app, ["doctor", "--cell", str(path), "--json", "--seconds", "0.5"])
    assert time.monotonic() - begin < 10.0
    assert result.exit_code == 3
    report = json.loads(result.stdout)
    assert not report["ok"]
    absent = {row["device"]: row["cure"] for row in report["findings"] if row["grade"] == "wrong"}
    assert set(absent) == {"arm", "gripper", "camera"}
    assert "check that the controller has booted" in absent["arm"]
    assert "check the Compute Box's power" in absent["gripper"]
    assert loopback(49) in absent["camera"]


def test_finger_tips_that_cannot_reach_the_preshape_are_refused(served: ServedCell, tmp_path: Path) -> None:
    path = tmp_path / "tips.toml"
    path.write_text(cell_text(HOST).replace("port =", "fingertip_offset_m = 0.02\nport ="))
    for command in (["doctor", "--seconds", "0.5"], ["pick", "--all", "--dry-run"], ["pick", "--all"]):
        result = CliRunner().invoke(app, [*command, "--cell", str(path), "--json"])
        assert result.exit_code == (3 if command[0] == "doctor" else 2)
        assert "gripper.preshape_m = 0.08: outside" in result.stdout
    # From Python, the cell does not open.
    with pytest.raises(ConfigError, match="to 70 mm"), open_cell(load_config(path)):
        pytest.fail("it opened")


def test_a_usb_camera_needs_its_rule_and_is_looked_for(tmp_path: Path) -> None:
    path = tmp_path / "usb.toml"
    path.write_text(cell_text(loopback(49)).replace(f"twin://{loopback(49)}:{CAMERA_PORT}", "usb"))
    findings = examine(load_config(path), SECONDS)
    assert any(finding.what == "udev rule" for finding in findings)
    assert any(finding.device == "camera" and "no RealSense" in finding.cure for finding in wrong(findings))


def test_a_cell_that_is_well_is_found_so_and_nothing_moves(served: ServedCell, config: CellConfig) -> None:
    before, width = joints(served), float(served.state()["width_m"])
    findings = examine(config, SECONDS)
    timing = {"RTDE", "Modbus", "frames"}  # of a busy machine they may be bad
    assert [finding for finding in wrong(findings) if finding.what not in timing] == []
    found = {(finding.device, finding.what): finding.value for finding in findings}
    assert found["arm", "PolyScope"].startswith("5.12")
    assert found["arm", "RTDE inputs"] == "free"
    assert found["gripper", "RG2"].startswith("firmware")
    assert "USB 3" in found["camera", "device"]
    assert " Hz of 125" in found["arm", "RTDE"]
    assert found["calibration", "file"] == "none"
    np.testing.assert_allclose(joints(served), before, atol=1e-3)
    assert float(served.state()["width_m"]) == pytest.approx(width, abs=1e-3)


def test_every_fault_is_a_row_with_its_cure(served: ServedCell, config: CellConfig) -> None:
    served.inject(fault("state", Kind.WRONG, "local_control"))
    served.inject(fault("state", Kind.WRONG, "speed_slider", 0.01))
    served.inject(fault("rtde", Kind.WRONG, "in_use"))
    try:
        cures = "\n".join(finding.cure for finding in wrong(examine(config, SECONDS)))
    finally:
        served.clear()
    for words in ("Remote Control", "slider is at 1 %", "EtherNet/IP"):
        assert words in cures


def test_only_hardware_is_examined() -> None:
    with pytest.raises(ConfigError, match=r"examples/hardware\.toml"):
        examine(load_config(), SECONDS)
    assert CliRunner().invoke(app, ["doctor"]).exit_code == 2


def test_recover_asks_first_and_then_leaves_the_stop(served: ServedCell, cell_file: Path) -> None:
    # Of a protective stop the controller lets nobody go for 5 s; tests/robotcell/drivers/ur5e waits for that.
    with make_arm() as arm:
        served.inject(fault("state", Kind.WRONG, "program_paused"))
        wait_until(lambda: arm.state().mode is ArmMode.NOT_READY)
        runner = CliRunner()
        for answer in ("n\n", ""):
            refused = runner.invoke(app, ["recover", "--cell", str(cell_file)], input=answer)
            assert refused.exit_code == 3
            assert "nothing moved" in refused.stderr
            assert arm.state().mode is ArmMode.NOT_READY
    left = runner.invoke(app, ["recover", "--cell", str(cell_file), "--yes"])
    assert left.exit_code == 0, left.output
    assert "a device is stopped" in left.stderr
    assert "the arm is ready, and no stop stands" in left.stdout
    again = runner.invoke(app, ["recover", "--cell", str(cell_file), "--yes"])
    assert again.exit_code == 0, again.output
    assert "nothing to recover from" in again.stdout
    with make_arm() as arm:
        assert arm.state().mode is ArmMode.READY


def test_recover_says_why_it_cannot(served: ServedCell, cell_file: Path) -> None:
    served.inject(fault("state", Kind.WRONG, "emergency_stop"))
    try:
        result = CliRunner().invoke(app, ["recover", "--cell", str(cell_file), "--yes"])
    finally:
        served.clear()
    assert result.exit_code == 3
    assert "release the button" in result.stderr.replace("\n", " ")
