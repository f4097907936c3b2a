from __future__ import annotations

import math
import sqlite3
import subprocess
import sys
from typing import TYPE_CHECKING

import pytest

from robotcell.errors import ConfigError, DeviceFault
from robotcell.jobs.journal import ActionRow, Frame, Journal, OutcomeRow

if TYPE_CHECKING:
    from pathlib import Path


def start_action(journal: Journal, job_id: int, primitive: str, goal: str | None = "red") -> int:
    frame_id = journal.add_frame(
        Frame(
            job_id=job_id,
            number=7,
            t=1.0,
            color_file="c.png",
            depth_file="d.png",
            coverage=0.9,
            tilt_rad=0.0,
            offset_m=0.0,
        )
    )
    return journal.start_action(
        ActionRow(
            job_id=job_id,
            frame_id=frame_id,
            goal=goal,
            primitive=primitive,
            row=1,
            col=2,
            rotation=3,
            x=-0.5,
            y=0.0,
            z=0.05,
            q_value=0.7,
            started_s=1.0,
        )
    )


def end_action(journal: Journal, action_id: int, result: str, success: bool, picked: str | None = None) -> None:
    journal.end_action(
        OutcomeRow(
            action_id=action_id,
            result=result,
            success=success,
            picked=picked,
            detail="",
            peak_force_n=1.0,
            ended_s=9.0,
        )
    )


def test_metrics_are_counted_as_the_paper_does(tmp_path: Path) -> None:
    with Journal(f"sqlite:///{tmp_path}/deep/journal.db") as journal:
        job = journal.start_job(("red",), "heuristic", {"workspace": {}}, tmp_path / "run")
        for primitive, result, success, picked in (
            ("push", "pushed", True, None),
            ("grasp", "missed", False, None),
            ("grasp", "wrong object", False, "blue"),
            ("grasp", "refused", False, None),
            ("grasp", "picked", True, "red"),
        ):
            end_action(journal, start_action(journal, job, primitive), result, success, picked)
        journal.end_job(job, "complete", "", cell_s=60.0)
        metrics = journal.metrics(job)
    # A refused action moved nothing, so it is no motion.
    assert (metrics.actions, metrics.pushes, metrics.grasp_attempts, metrics.grasp_successes) == (4, 1, 3, 1)
    assert metrics.picked == ("blue", "red")
    assert metrics.grasp_success_rate == pytest.approx(1 / 3)
    assert metrics.picks_per_hour == pytest.approx(60.0)


def test_an_action_is_on_record_before_it_ends(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path}/journal.db"
    with Journal(url) as journal, Journal(url) as reader:
        job_id = journal.start_job(None, "heuristic", {}, tmp_path)
        start_action(journal, job_id, "grasp", goal=None)
        job = reader.job(job_id)
        assert (job.status, job.goals) == ("running", None)
        assert job.actions[0].outcome is None
        assert job.actions[0].frame.number == 7
        metrics = reader.metrics(job_id)
    assert metrics.actions == 0
    assert math.isnan(metrics.grasp_success_rate)
    assert math.isnan(metrics.picks_per_hour)


def test_jobs_are_listed_newest_first(tmp_path: Path) -> None:
    with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
        ids = [journal.start_job(None, "heuristic", {}, tmp_path) for _ in range(3)]
        assert [job.id for job in journal.jobs(limit=2)] == ids[:0:-1]


def test_an_unknown_job_says_which_exist(tmp_path: Path) -> None:
    with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
        with pytest.raises(ConfigError, match="no job 5; the journal is empty"):
            journal.job(5)
        journal.start_job(None, "heuristic", {}, tmp_path)
        with pytest.raises(ConfigError, match="no job 5; ids run from 1 to 1"):
            journal.job(5)


@pytest.mark.parametrize("url", ["nonsense", "sqlite:////proc/no/journal.db", "spanner://x/y"])
def test_a_journal_that_cannot_be_opened_says_so(url: str) -> None:
    with pytest.raises(ConfigError, match=r"journal\.url = .*cannot be opened"):
        Journal(url)


def test_a_password_is_not_shown() -> None:
    with pytest.raises(ConfigError) as caught:
        Journal("postgresql://cell:secret@nowhere.invalid/journal")
    assert "secret" not in str(caught.value)


def test_a_foreign_database_is_an_error_of_the_setting(tmp_path: Path) -> None:
    connection = sqlite3.connect(tmp_path / "other.db")
    connection.execute("CREATE TABLE jobs (id INTEGER PRIMARY KEY, title TEXT)")
    connection.close()
    with Journal(f"sqlite:///{tmp_path}/other.db") as journal:
        with pytest.raises(ConfigError, match="cannot be read"):
            journal.jobs()
        with pytest.raises(DeviceFault, match="cannot be written"):
            journal.start_job(None, "heuristic", {}, tmp_path)


def test_two_processes_may_open_a_new_journal_at_once(tmp_path: Path) -> None:
    code = f"from robotcell.jobs.journal import Journal\nJournal('sqlite:///{tmp_path}/journal.db').close()"
    with (
        subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as first,
        subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True) as second,
    ):
        errors = first.communicate()[1] + second.communicate()[1]
    assert errors == ""
