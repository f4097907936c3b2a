from __future__ import annotations

import math
import shutil
import sqlite3
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from datetime import datetime, timezone
from typing import TYPE_CHECKING

import numpy as np
import pytest

from robotcell.config.schema import JournalPlace
from robotcell.errors import ConfigError, StorageError
from robotcell.io.lock_file import LockFile
from robotcell.jobs.journal import ActionRow, Frame, Journal, OutcomeRow
from robotcell.jobs.opening import JournalStops
from robotcell.motion.guard import Stop

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
            rotation=3,
            x=-0.5,
            y=0.0,
            surface_m=0.05,
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


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    place = JournalPlace(runs=tmp_path / "runs?mode=ro #2 50%")
    with Journal(place.database_url()) as journal:
        journal.start_job(None, "heuristic", {}, tmp_path)
    assert place.default_file.is_file()
    with Journal(place.database_url()) as journal:
        assert len(journal.jobs()) == 1


def test_a_journal_whose_file_was_removed_takes_nothing_more(tmp_path: Path) -> None:
    with Journal(tmp_path / "runs" / "journal.db") as journal:
        journal.start_job(None, "heuristic", {}, tmp_path)
        shutil.rmtree(tmp_path / "runs")
        with pytest.raises(StorageError, match="was removed"):
            journal.start_job(None, "heuristic", {}, tmp_path)


def test_a_stop_stands_for_its_cell_until_it_is_cleared(tmp_path: Path) -> None:
    place = JournalPlace(runs=tmp_path / "runs")
    here, elsewhere = (JournalStops(place, cell) for cell in ("arm-192.168.1.10", "arm-192.168.1.11"))
    assert here.load() is None
    assert not place.runs.exists(), "asking makes no journal"
    stop = Stop("the tool feels 120 N", datetime(2026, 5, 4, 3, 2, 1, tzinfo=timezone.utc), np.arange(6.0))
    with Journal(place.database_url()) as journal:
        lock = LockFile("arm-192.168.1.10")
        running = journal.start_job(("red",), "heuristic", {}, tmp_path, lock)
    here.save(stop)
    found = JournalStops(place, "arm-192.168.1.10").load()
    assert found is not None
    assert (found.what, found.at, found.job) == (stop.what, stop.at, running)
    np.testing.assert_array_equal(found.q, stop.q)
    assert elsewhere.load() is None
    elsewhere.clear()
    assert here.load() is not None
    here.clear()
    assert here.load() is None


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


@pytest.mark.parametrize(
    ("url", "error"),
    [("nonsense", ConfigError), ("sqlite:////proc/no/journal.db", StorageError), ("spanner://x/y", ConfigError)],
)
def test_a_journal_that_cannot_be_opened_says_so(url: str, error: type[Exception]) -> None:
    with pytest.raises(error, match=r"journal\.url = .*cannot be opened"):
        Journal(url)


def test_a_password_is_not_shown() -> None:
    with pytest.raises(ConfigError) as caught:
        Journal("postgresql://cell:secret@nowhere.invalid/journal")
    assert "secret" not in str(caught.value)


def test_the_database_of_another_program_is_refused_and_left_alone(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
        connection.execute("CREATE TABLE songs (id INTEGER PRIMARY KEY, title TEXT)")
    with pytest.raises(ConfigError, match="tables are those of another program"):
        Journal(f"sqlite:///{tmp_path}/other.db")
    with closing(sqlite3.connect(tmp_path / "other.db")) as connection:
        assert connection.execute("SELECT name FROM sqlite_master").fetchall() == [("songs",)]


def test_a_journal_of_a_newer_program_is_refused(tmp_path: Path) -> None:
    Journal(f"sqlite:///{tmp_path}/journal.db").close()
    with closing(sqlite3.connect(tmp_path / "journal.db")) as connection:
        connection.execute("UPDATE alembic_version SET version_num = '9999'")
        connection.commit()
    with pytest.raises(ConfigError, match="schema 9999 and this program knows"):
        Journal(f"sqlite:///{tmp_path}/journal.db")


# As the first journals were made, before revisions were noted.
FIRST_SCHEMA = """
CREATE TABLE jobs (id INTEGER NOT NULL, started DATETIME NOT NULL, ended DATETIME, goals JSON, policy VARCHAR NOT NULL,
    config JSON NOT NULL, run_dir VARCHAR NOT NULL, status VARCHAR NOT NULL, reason VARCHAR NOT NULL, cell_s FLOAT,
    PRIMARY KEY (id));
CREATE TABLE frames (id INTEGER NOT NULL, job_id INTEGER NOT NULL, number INTEGER NOT NULL, t FLOAT NOT NULL,
    color_file VARCHAR NOT NULL, depth_file VARCHAR NOT NULL, coverage FLOAT NOT NULL, tilt_rad FLOAT NOT NULL,
    offset_m FLOAT NOT NULL, PRIMARY KEY (id), FOREIGN KEY(job_id) REFERENCES jobs (id));
CREATE TABLE actions (id INTEGER NOT NULL, job_id INTEGER NOT NULL, frame_id INTEGER NOT NULL, goal VARCHAR,
    primitive VARCHAR NOT NULL, row INTEGER NOT NULL, col INTEGER NOT NULL, rotation INTEGER NOT NULL, x FLOAT NOT NULL,
    y FLOAT NOT NULL, z FLOAT NOT NULL, q_value FLOAT NOT NULL, started_s FLOAT NOT NULL, PRIMARY KEY (id),
    FOREIGN KEY(job_id) REFERENCES jobs (id), FOREIGN KEY(frame_id) REFERENCES frames (id));
CREATE TABLE outcomes (action_id INTEGER NOT NULL, result VARCHAR NOT NULL, success BOOLEAN NOT NULL, picked VARCHAR,
    detail VARCHAR NOT NULL, peak_force_n FLOAT NOT NULL, ended_s FLOAT NOT NULL, PRIMARY KEY (action_id),
    FOREIGN KEY(action_id) REFERENCES actions (id));
INSERT INTO jobs VALUES (1, '2026-01-02 03:04:05', NULL, '["red"]', 'learned', '{"table": {"height_m": 0.02}}',
    'runs/a', 'complete', '', 8.5);
INSERT INTO frames VALUES (1, 1, 7, 1.0, 'c.png', 'd.png', 0.9, 0.0, 0.0);
INSERT INTO actions VALUES (1, 1, 1, 'red', 'push', 3, 4, 5, -0.5, 0.1, 0.07, 0.8, 1.5);
INSERT INTO outcomes VALUES (1, 'pushed', 1, NULL, 'moved', 12.5, 4.0);
"""


def test_a_journal_of_the_first_schema_is_migrated_with_all_that_it_holds(tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "journal.db")) as connection:
        connection.executescript(FIRST_SCHEMA)
    for _ in range(2):  # the second time there is nothing to do
        with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
            (action,) = journal.job(1).actions
            assert action.surface_m == pytest.approx(0.05)
            assert (action.primitive, action.rotation, action.x, action.end_x) == ("push", 5, -0.5, None)
            assert action.outcome is not None
            assert (action.outcome.peak_force_n, action.outcome.grip_force_n) == (12.5, None)
            assert action.frame.color_file == "c.png"
            assert journal.metrics(1).pushes == 1
            assert (journal.job(1).lock, journal.job(1).owner, action.task, action.held) == (None,) * 4
            assert journal.standing_stop("arm-192.168.1.10") is None
    with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
        start_action(journal, 1, "grasp")
        assert len(journal.job(1).actions) == 2
    with closing(sqlite3.connect(tmp_path / "journal-0001.db")) as connection:
        assert connection.execute("SELECT z FROM actions").fetchall() == [(0.07,)]


def test_many_may_open_a_new_journal_at_once(tmp_path: Path) -> None:
    # Threads, each with a journal of its own, contend for the file as processes do.
    count = 8
    together = threading.Barrier(count)

    def record(number: int) -> None:
        together.wait()
        with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
            journal.start_job(None, f"policy {number}", {}, tmp_path)

    with ThreadPoolExecutor(count) as pool:
        list(pool.map(record, range(count)))
    with Journal(f"sqlite:///{tmp_path}/journal.db") as journal:
        assert {job.policy for job in journal.jobs()} == {f"policy {number}" for number in range(count)}
