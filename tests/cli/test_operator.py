"""One command at a time has a cell, and another one can stop it; over the wire, a stop and what follows it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from multiprocessing import resource_tracker
from typing import TYPE_CHECKING

import numpy as np
import pytest
from typer.testing import CliRunner

from cli.main import app
from robotcell.config import load_config
from robotcell.io.lock_file import LockFile
from robotcell.jobs.journal import Journal
from sim_twin.wire.cell import ServedCell
from tests.benchmarks.killed_jobs import kill_and_resume

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from click.testing import Result

HOST, MODBUS_PORT, CAMERA_PORT = "127.0.0.54", 15054, 30454
SCENE = """
name = "one cube"
[[object]]
name = "cube"
shape = "cube"
color = "red"
position = [0.0, 0.0, 0.025]
"""
LIMIT_S = 240.0


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


@pytest.fixture
def cell_file(tmp_path: Path) -> Path:
    path = tmp_path / "cell.toml"
    path.write_text(
        f'[backend]\nname = "hardware"\n[backend.options.arm]\nhost = "{HOST}"\n'
        f'[backend.options.gripper]\nhost = "{HOST}"\nport = {MODBUS_PORT}\n'
        f'[backend.options.camera]\nsource = "twin://{HOST}:{CAMERA_PORT}"\n'
        f'[journal]\nruns = "{tmp_path / "runs"}"\n'
    )
    return path


@pytest.fixture
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.mark.usefixtures("_own_locks")
def test_a_cell_that_is_in_use_is_opened_by_nobody_else(cell_file: Path) -> None:
    owner = LockFile(f"arm-{HOST}")
    assert owner.acquire() is None
    try:
        for command in (("pick", "--all", "--policy", "heuristic"), ("recover", "--yes"), ("calibrate", "--yes")):
            refused = run(*command, "--cell", cell_file)
            assert refused.exit_code == 3, refused.output
            assert "is in use by" in refused.stderr.replace("\n", " ")
            assert "robotcell stop" in refused.stderr.replace("\n", " ")
        assert run("jobs", "--cell", cell_file).exit_code == 0, "what only reads needs no lock"
    finally:
        owner.release()


@pytest.mark.usefixtures("_own_locks")
def test_stop_ends_the_command_that_has_the_cell_and_waits_for_it(cell_file: Path) -> None:
    nobody = run("stop", "--cell", cell_file)
    assert nobody.exit_code == 0
    assert "no command has the cell open" in nobody.stdout
    code = (
        f"from robotcell.io.lock_file import LockFile\nimport time\nlock = LockFile('arm-{HOST}')\nlock.acquire()\n"
        "print('held', flush=True)\ntry:\n    time.sleep(60)\n"
        "except KeyboardInterrupt:\n    print('told', flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "held\n"
        stopped = run("stop", "--cell", cell_file)
        assert stopped.exit_code == 0, stopped.output
        assert "no emergency stop" in stopped.stderr
        assert str(process.pid) in stopped.stdout
        assert process.stdout.readline() == "told\n"
    assert run("stop").exit_code == 2, "a twin is nobody else's"


def test_a_job_whose_process_is_gone_is_interrupted_and_not_running(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(f'[journal]\nruns = "{tmp_path / "runs"}"\n[backend.options]\nobjects = 2\n')
    with Journal(load_config(path).journal.database_url()) as journal:
        journal.start_job(None, "heuristic", {}, tmp_path, LockFile("process-1"))
    assert "interrupted" in run("jobs", "--cell", path).stdout
    refused = run("resume", "1", "--cell", path)
    assert refused.exit_code == 2, refused.output
    assert "ended with its process" in refused.stderr.replace("\n", " ")


@pytest.fixture(scope="module")
def _tracker() -> None:
    """The process of the standard library that keeps an eye on shared memory, which stays."""
    resource_tracker.ensure_running()


@pytest.fixture
def served(_tracker: None, tmp_path: Path) -> Iterator[ServedCell]:
    scene = tmp_path / "cube.toml"
    scene.write_text(SCENE)
    with ServedCell(load_config(None, {"backend.options.scene": str(scene)}), HOST, MODBUS_PORT, CAMERA_PORT) as cell:
        yield cell


@pytest.mark.wire
def test_after_a_stop_in_a_motion_nothing_moves_until_recovered_and_the_job_goes_on(
    served: ServedCell, cell_file: Path
) -> None:
    command = [sys.executable, "-c", "from cli.main import main; main()", "pick", "--goal", "red", "--cell"]
    with subprocess.Popen([*command, str(cell_file)], stderr=subprocess.DEVNULL) as process:
        end = time.monotonic() + LIMIT_S
        while np.abs(served.state()["qd"]).max() < 0.2 and time.monotonic() < end:
            time.sleep(0.02)
        stopped = run("stop", "--cell", cell_file)
        process.send_signal(signal.SIGINT)
        assert process.wait(LIMIT_S) in {130, -signal.SIGINT}
    assert stopped.exit_code == 0, stopped.output
    assert "robotcell recover comes first" in stopped.stdout.replace("\n", " ")
    stood = served.state()["q"].copy()
    refused = run("pick", "--goal", "red", "--cell", cell_file)
    assert refused.exit_code == 3
    assert "robotcell recover" in refused.stderr.replace("\n", " ")
    np.testing.assert_allclose(served.state()["q"], stood, atol=1e-3)
    recovered = run("recover", "--yes", "--cell", cell_file)
    assert recovered.exit_code == 0, recovered.output
    np.testing.assert_allclose(served.state()["q"], load_config().motion.home_q, atol=0.01)
    done = run("resume", "--json", "--cell", cell_file)
    assert json.loads(done.stdout)["picked_objects"] == ["red"], done.output


@pytest.mark.wire
@pytest.mark.usefixtures("_tracker")
@pytest.mark.parametrize("seed", [1, 2])
def test_a_job_that_was_killed_counts_each_object_once(tmp_path: Path, seed: int) -> None:
    job = kill_and_resume(seed, 1, tmp_path, (HOST, MODBUS_PORT, CAMERA_PORT))
    assert job.counted_once, job
    assert job.completed, job
