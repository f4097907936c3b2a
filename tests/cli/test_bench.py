from __future__ import annotations

import json
import signal
import subprocess
import sys
from multiprocessing import resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from typer.testing import CliRunner, Result

from cli.main import app

if TYPE_CHECKING:
    from collections.abc import Iterator

SCENE = """
name = "one or two"

[[object]]
name = "goal"
shape = "cube"
color = "red"
position = [0.0, 0.1, 0.025]
"""
OTHER = """
[[object]]
name = "other"
shape = "plank"
color = "blue"
position = [-0.1, -0.1, 0.0125]
"""
# What a clock or a processor has a say in.
CLOCKS = {"wall_s", "decision_s"}


@pytest.fixture
def cell(tmp_path: Path) -> Path:
    """A cell file whose runs go to the test's own folder, beside a folder of two scenes."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "one.toml").write_text(SCENE)
    (tmp_path / "scenes" / "two.toml").write_text(SCENE + OTHER)
    path = tmp_path / "cell.toml"
    # An arm that is there sooner makes a job shorter, and no other one.
    brisk = "[motion]\njoint_acceleration_rad_s2 = 4.0\nlinear_acceleration_m_s2 = 4.0\n"
    path.write_text(f'[journal]\nruns = "{tmp_path / "runs"}"\n{brisk}')
    return path


@pytest.fixture
def no_tracker() -> Iterator[None]:
    """multiprocessing keeps a process for resources that these tests do not use until the interpreter ends."""
    yield
    resource_tracker._resource_tracker._stop()


def bench(cell: Path, *arguments: str | Path) -> Result:
    words = ["bench", "--cell", cell, "--scenes", cell.parent / "scenes", "--trials", "1", *arguments]
    return CliRunner().invoke(app, [str(word) for word in words])


def trials_of(path: Path) -> list[dict[str, Any]]:
    trials = json.loads(path.read_text())["trials"]
    return [{key: value for key, value in trial.items() if key not in CLOCKS} for trial in trials]


def test_two_policies_are_compared(cell: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.json"
    result = bench(cell, "--suite", "challenging", "--policy", "heuristic,learned", "--json", out)
    assert result.exit_code == 0, result.output
    assert "heuristic" in result.stdout
    assert "EPG, published" in result.stdout
    page = Path(result.stdout.splitlines()[-1].removeprefix("page: "))
    assert page.parent.parent == tmp_path / "runs"
    assert "one.toml" in page.read_text()
    document = json.loads(out.read_text())
    assert document["version"] == 1
    assert document["versions"]["pybullet"]
    metrics = document["metrics"]["challenging"]
    assert list(metrics) == ["heuristic", "learned"]
    assert metrics["heuristic"]["completion"]["value"] == 1.0
    assert [(t["scene"], t["policy"]) for t in document["trials"]] == [
        (scene, policy) for scene in ("one.toml", "two.toml") for policy in ("heuristic", "learned")
    ]


@pytest.mark.usefixtures("no_tracker")
def test_two_workers_and_a_resumed_run_give_what_one_run_gives(cell: Path, tmp_path: Path) -> None:
    first, again, third = (tmp_path / f"{name}.json" for name in ("first", "again", "third"))
    # The heuristic policy starts without the libraries of the network.
    agnostic = ("--suite", "agnostic", "--policy", "heuristic")
    assert bench(cell, *agnostic, "--json", first).exit_code == 0
    both = bench(cell, *agnostic, "--json", again, "--workers", "2")
    assert both.exit_code == 0, both.output
    assert trials_of(first) == trials_of(again)
    folder = Path(both.stdout.splitlines()[-1].removeprefix("page: ")).parent
    lines = folder / "trials.jsonl"
    kept = lines.read_text().splitlines(keepends=True)[0]
    lines.write_text(kept)
    resumed = CliRunner().invoke(app, ["bench", "--resume", str(folder), "--json", str(third)])
    assert resumed.exit_code == 0, resumed.output
    assert "1 of 2 trials to run" in resumed.stderr
    assert lines.read_text().startswith(kept)
    assert trials_of(third) == trials_of(first)
    other = CliRunner().invoke(app, ["bench", "--resume", str(folder), "--seed", "4", "--suite", "agnostic"])
    assert other.exit_code == 2
    assert "another benchmark (--seed 0)" in other.stderr


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_benchmark_that_is_cut_off_says_how_to_go_on(cell: Path, number: signal.Signals, code: int) -> None:
    options = ["--suite", "challenging", "--policy", "heuristic", "--cell", str(cell), "--workers", "2"]
    command = [sys.executable, "-c", "from cli.main import main; main()", "bench", *options]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True) as process:
        assert process.stderr is not None
        assert "30 of 30 trials to run" in process.stderr.readline()
        process.send_signal(number)
        rest = process.stderr.read()
        assert process.wait() == code
    assert "robotcell bench --resume" in rest
    assert "Traceback" not in rest


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "say --suite"),
        (("--suite", "random,easy"), "no suite is called 'easy'; there are random, challenging"),
        (("--suite", "novel", "--policy", "oracle"), "no policy is called 'oracle'"),
        (("--suite", "novel", "--trials", "0"), "0 trials per scene"),
        (("--suite", "novel", "--seed", "-1"), "seeds start at 0"),
        (("--suite", "novel", "--workers", "0"), "at least one has to do the work"),
        (("--suite", "novel", "--meshes", "."), "name their folder with --scenes"),
        (("--suite", "novel", "--scenes", "nowhere"), "no such folder; --scenes"),
        (("--suite", "novel", "--scenes", "."), "no scene files in it"),
        (("--suite", "novel", "--cell", "nowhere.toml"), "nowhere.toml: no such file"),
        (("--suite", "novel", "--json", "nowhere/x.json"), "there is no folder nowhere"),
        (("--resume", "nowhere"), "--resume names the folder of a benchmark"),
    ],
)
def test_a_refusal_says_why(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["bench", *arguments])
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert "Traceback" not in result.stderr
