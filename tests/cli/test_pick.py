from __future__ import annotations

import io
import json
import logging
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from cli.main import app
from cli.options import CellChoice
from cli.pick import run_pick
from robotcell.config import load_config
from robotcell.jobs.journal import Journal

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

SCENE = """
name = "three blocks"
drop = false

[[object]]
name = "goal"
shape = "cube"
color = "red"
position = [0.0, 0.1, 0.025]

[[object]]
name = "second"
shape = "plank"
color = "blue"
position = [-0.1, -0.1, 0.0125]

[[object]]
name = "third"
shape = "cylinder"
color = "yellow"
position = [0.1, -0.05, 0.025]
"""
# An arm that is there sooner makes a job shorter, and no other one.
BRISK = "[motion]\njoint_acceleration_rad_s2 = 4.0\nlinear_acceleration_m_s2 = 4.0\n"


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """A cell file whose twin holds three blocks and whose runs go to the test's own folder."""
    (tmp_path / "blocks.toml").write_text(SCENE)
    path = tmp_path / "cell.toml"
    path.write_text(
        f'[journal]\nruns = "{tmp_path / "runs"}"\n{BRISK}[backend.options]\nscene = "{tmp_path / "blocks.toml"}"\n'
    )
    return path


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def run_json(*arguments: str | Path) -> dict[str, Any]:
    """What a command prints as JSON, and nothing else."""
    result = run(*arguments, "--json")
    assert result.exit_code == 0, result.output
    summary: dict[str, Any] = json.loads(result.stdout)
    return summary


def test_a_goal_is_picked_from_the_command_line_and_a_refusal_has_the_same_keys_in_json(cell: Path) -> None:
    refused = json.loads(run("pick", "--cell", cell, "--goal", "mauve", "--json").stdout)
    summary = run_json("pick", "--goal", "red", "--cell", cell)
    assert refused.keys() == summary.keys()
    assert refused["job"] is None
    assert summary["completed"] is True
    assert summary["picked"] == 1
    assert summary["actions"] == summary["pushes"] + summary["grasp_attempts"]
    assert summary["simulated_s"] > 5
    run_dir = Path(summary["run_dir"])
    pages = sorted(run_dir.glob("step-*.png"))
    assert len(pages) == summary["actions"]
    assert cv2.imread(str(pages[0])).shape == (514, 1600, 3)
    with Image.open(run_dir / "summary.gif") as animation:
        assert animation.n_frames == summary["actions"] + 1  # type: ignore[attr-defined]


def run_as_process(*arguments: str | Path) -> dict[str, Any]:
    """In a process of its own, whatever any library prints as it is loaded, or warns of, would spoil the JSON."""
    completed = subprocess.run(
        [sys.executable, "-W", "error", "-c", "from cli.main import main; main()", *map(str, arguments), "--json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert completed.returncode == 0, completed.stderr
    assert "pybullet" not in completed.stderr
    summary: dict[str, Any] = json.loads(completed.stdout)
    return summary


def test_the_same_seed_gives_the_same_job_to_the_last_action_in_every_process(tmp_path: Path) -> None:
    def once(folder: str, pick: Callable[..., dict[str, Any]]) -> tuple[Any, ...]:
        path = tmp_path / f"{folder}.toml"
        path.write_text(f'[journal]\nruns = "{tmp_path / folder}"\n{BRISK}')
        summary = pick("pick", "--all", "--cell", path, "--objects", "2", "--seed", "5")
        assert summary["picked"] == 2
        listing = run("jobs", "show", str(summary["job"]), "--cell", path).stdout
        table = [line for line in listing.splitlines() if "pictures" not in line]
        return summary["simulated_s"], summary["picked_objects"], table[: table.index(table[-1])]

    assert once("first", run_as_process) == once("second", run_json)


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [(signal.SIGINT, 130, "interrupted"), (signal.SIGHUP, 129, "the terminal was closed")],
)
def test_a_job_that_is_cut_off_is_on_record_as_stopped(
    cell: Path, number: signal.Signals, code: int, words: str
) -> None:
    # The heuristic policy starts without the libraries of the network.
    options = ["--all", "--policy", "heuristic", "--cell", str(cell)]
    command = [sys.executable, "-c", "from cli.main import main; main()", "pick", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        # The first line comes when the job has started.
        assert process.stderr.readline().startswith("job 1")
        process.send_signal(number)
        process.stderr.read()
        assert process.wait() == code
    shown = run("jobs", "show", "1", "--cell", cell).stdout
    assert "stopped" in shown
    assert words in shown


def test_a_dry_run_draws_and_moves_nothing(cell: Path, tmp_path: Path) -> None:
    summary = run_json("pick", "--goal", "red", "--cell", cell, "--dry-run")
    assert summary["primitive"] == "grasp"
    assert "descend guarded" in summary["steps"]
    assert Path(summary["picture"]).is_file()
    assert not (tmp_path / "runs" / "journal.db").exists()


def test_jobs_are_listed_and_shown(cell: Path) -> None:
    assert "no jobs yet" in run("jobs", "--cell", cell).stdout
    assert not (cell.parent / "runs").exists()
    picked = run("pick", "--goal", "blue", "--cell", cell)
    assert picked.exit_code == 0, picked.output
    listing = run("jobs", "--cell", cell)
    assert "complete" in listing.stdout
    shown = run("jobs", "show", "1", "--cell", cell)
    assert shown.exit_code == 0
    assert "pick blue with learned, complete" in shown.stdout
    missing = run("jobs", "show", "9", "--cell", cell)
    assert missing.exit_code == 2
    assert "no job 9" in missing.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (("--goal", "mauve"), 2, "mauve"),
        ((), 2, "say either --goal"),
        (("--goal", "red", "--all"), 2, "say either --goal"),
        (("--goal", "red", "--objects", "0"), 2, "--objects 0: Input should be"),
        (("--goal", "red", "--set", "limits.force_n=-1"), 2, "--set limits.force_n=-1: Input should be"),
        (("--goal", "red", "--set", "limits.force=1"), 2, "--set limits.force=1: unknown key"),
        (("--goal", "red", "--set", "limits"), 2, "say KEY=VALUE"),
        (("--goal", "red", "--policy", "oracle"), 2, "no policy is called 'oracle'"),
        (("--goal", "red", "--scene", "moon"), 2, "moon"),
        (("--goal", "red", "--speed", "0.01"), 2, "--speed 0.01: Input should be greater than or equal to 0.05"),
        (("--goal", "red", "--confirm"), 2, "there is no terminal to ask at"),
        (("--goal", "red", "--confirm", "--dry-run"), 2, "a dry run moves nothing"),
        (("--goal", "green"), 1, "no green object"),
    ],
)
def test_a_refusal_says_why(cell: Path, arguments: tuple[str, ...], code: int, message: str) -> None:
    result = run("pick", "--cell", cell, *arguments)
    assert result.exit_code == code, result.output
    assert message in result.stderr


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_each_action_is_shown_and_asked_for_at_the_terminal(cell: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdin", Terminal("n\ny\n"))
    choice = CellChoice(cell, None, {"--policy": "heuristic", "--speed": 0.5})
    assert run_pick("red", False, choice, confirm=True, dry_run=False, as_json=True) == 0
    with Journal(load_config(cell).journal.database_url()) as journal:
        job = journal.job(1)
    assert [row.outcome.result for row in job.actions if row.outcome] == ["declined", "picked"]
    assert job.config["motion"]["speed_fraction"] == 0.5
    assert len(list(Path(job.run_dir).glob("confirm-*.png"))) == 2


def test_what_was_done_before_a_refusal_is_in_the_json(cell: Path) -> None:
    result = run("pick", "--cell", cell, "--goal", "red,green", "--json")
    assert result.exit_code == 1
    summary = json.loads(result.stdout)
    assert summary["completed"] is False
    assert "no green object" in summary["reason"]
    assert summary["code"] == "no-target"
    assert summary["picked_objects"] == ["red"]
    assert (Path(summary["run_dir"]) / "summary.gif").is_file()


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text('[journal]\nruns = "/dev/null/runs"\n')
    for arguments in (("--dry-run",), ()):
        result = run("pick", "--goal", "red", "--cell", path, *arguments)
        assert result.exit_code == 3, result.output
        assert "/dev/null/runs" in result.stderr
    shown = json.loads(run("pick", "--goal", "red", "--cell", path, "--json").stdout)
    assert (shown["code"], shown["device"]) == ("storage", None)


def test_brackets_in_a_path_are_printed_as_they_are(tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text(f'[journal]\nruns = "{tmp_path}/r[bold]x"\n{BRISK}[backend.options]\nobjects = 1\n')
    result = run("pick", "--all", "--cell", path)
    assert result.exit_code == 0, result.output
    assert "r[bold]x" in result.stdout
    assert "[m]" in run("jobs", "show", "1", "--cell", path).stdout


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\nfrom typer.testing import CliRunner\nfrom cli.main import app\n"
        "result = CliRunner().invoke(app, ['--help'])\nassert 'pick' in result.stdout\n"
        "heavy = {'numpy', 'cv2', 'scipy', 'pydantic', 'sqlalchemy', 'pybullet', 'open3d'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    completed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert completed.returncode == 0, completed.stderr


def test_settings_of_the_command_line_stand_above_the_file_and_goals_are_read_in_any_case(
    cell: Path, tmp_path: Path
) -> None:
    elsewhere = tmp_path / "elsewhere"
    done = run(
        "pick",
        "--goal",
        "RED",
        "--cell",
        cell,
        "--set",
        f'journal.runs="{elsewhere}"',
        "--set",
        "motion.approach_m=0.12",
    )
    assert done.exit_code == 0, done.output
    assert (elsewhere / "journal.db").is_file()
    assert "red" in run("jobs", "--set", f"journal.runs={elsewhere}").stdout


def test_the_version_is_that_of_the_package() -> None:
    assert run("--version").stdout.startswith("robotcell 0.")


@pytest.fixture
def quiet_again() -> Iterator[None]:
    """What --verbose adds to the program's log is taken away."""
    log = logging.getLogger("robotcell")
    handlers, level = list(log.handlers), log.level
    yield
    log.handlers[:] = handlers
    log.setLevel(level)


@pytest.mark.usefixtures("quiet_again")
def test_verbose_tells_where_an_error_comes_from(cell: Path) -> None:
    refused = run("pick", "--goal", "mauve", "--cell", cell, "-v")
    assert refused.exit_code == 2
    assert "where it came from" in refused.stderr
    assert "goal_color" in refused.stderr
