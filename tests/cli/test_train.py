from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from typing import TYPE_CHECKING

import pytest
from typer.testing import CliRunner, Result

from cli.main import app

if TYPE_CHECKING:
    from pathlib import Path

# The first scene of all is held out, so two are the fewest that can be learned from.
CONFIG = """
scenes_per_task = 1
[learning]
grasps = 2
pushes = 2
[stage1]
grasps = 2
pushes = 1
states = 1
rounds = 1
scenes_per_round = 2
updates_per_round = 1
warmup_rounds = 1
"""


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["train", *map(str, arguments)])


def command(*arguments: str | int | Path) -> list[str]:
    """In a process of its own, in which any library's warning is an error."""
    start = "from cli.main import main; main()"
    return [sys.executable, "-W", "error", "-c", start, "train", *map(str, arguments)]


@pytest.fixture
def config(tmp_path: Path) -> Path:
    path = tmp_path / "train.toml"
    path.write_text(CONFIG)
    return path


def test_help_imports_nothing_heavy() -> None:
    code = "import sys; from cli.main import app; app(['train', '--help'], standalone_mode=False)\n"
    code += "print([name for name in ('torch', 'numpy', 'pybullet', 'matplotlib', 'scipy') if name in sys.modules])"
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "--from-scratch" in output
    assert output.splitlines()[-1] == "[]"


def test_it_trains_in_the_twin(config: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done = run("--stage", "1", "--config", config, "--run", folder, "--workers", "1")
    assert done.exit_code == 0, done.output
    assert done.stdout.splitlines() == [str(folder / "stage1" / "weights.safetensors")]
    assert "round 1/1: " in done.stderr
    line = json.loads((folder / "metrics.jsonl").read_text())
    assert line["attempts"] >= 4
    assert line["updates"] == 1
    assert (folder / "curves.png").stat().st_size > 10_000


def test_an_interrupt_says_how_to_go_on(config: Path, tmp_path: Path) -> None:
    config.write_text(CONFIG.replace("scenes_per_round = 2", "scenes_per_round = 100"))
    folder = tmp_path / "run"
    with subprocess.Popen(
        command("--stage", 1, "--config", config, "--run", folder, "--workers", 1), stderr=subprocess.PIPE, text=True
    ) as process:
        while not list(folder.glob("stage1/shards/*.npz")):
            assert process.poll() is None
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 130
    assert f"go on with: robotcell train --stage 1 --run {folder} --resume" in errors
    assert "Traceback" not in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--stage", 1, "--resume"], "there is nothing to resume; start it without --resume"),
        (["--stage", 2], "run --stage 1 first, or --from-scratch"),
        (["--stage", 1, "--from-scratch"], "use --stage 2"),
        (["--stage", 1, "--config", "missing.toml"], "missing.toml: no such file"),
        (["--stage", 1, "--rounds", 100_000], "stage1"),
    ],
)
def test_wrong_use_is_explained(arguments: list[str | int], message: str, tmp_path: Path) -> None:
    result = run(*map(str, arguments), "--run", tmp_path / "run")
    assert result.exit_code == 2
    assert message in result.output.replace("\n", "")
    assert not (tmp_path / "run").exists()


def test_a_stage_is_not_started_twice(config: Path, tmp_path: Path) -> None:
    (tmp_path / "run" / "stage1").mkdir(parents=True)
    (tmp_path / "run" / "stage1" / "train.toml").write_text(CONFIG)
    result = run("--stage", 1, "--config", config, "--run", tmp_path / "run")
    assert result.exit_code == 2
    assert "go on with --resume, or choose another --run" in result.output.replace("\n", "")


def test_a_stage_is_1_or_2() -> None:
    assert run("--stage", 3).exit_code == 2
