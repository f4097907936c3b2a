"""The record of every job: a database in which a row is committed before an action starts and another after it ends.

The figures of the paper's tables are queries over it.
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import create_engine, event, func, select, update
from sqlalchemy.engine import URL, make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError
from sqlalchemy.orm import Session

from robotcell.errors import ConfigError, StorageError
from robotcell.jobs.journal_schema import bring_up_to_date
from robotcell.jobs.journal_tables import GRASP, ActionRow, Frame, Job, OutcomeRow, StopRow
from robotcell.jobs.ownership import owner

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from typing_extensions import Self

    from robotcell.io.lock_file import LockFile


# How long a SQLite file may be locked by others before that is an error. A write takes milliseconds; a stopped arm must
# not wait long for its record.
_LOCKED_S = 2.0


# Results of actions in which nothing moved (`robotcell.jobs.verdict.Result`).
NOT_RUN = ("refused", "declined")


@dataclass(frozen=True)
class Metrics:
    """The figures of a job.

    Attributes:
        actions: executed pushes and grasps (the paper's motion number).
        pushes, grasp_attempts, grasp_successes: counts; a grasp of another object than the goal is no success.
        picked: colours of the objects that left the table, in order, wrong ones included.
        grasp_success_rate: successes / attempts; NaN without an attempt.
        picks_per_hour: successes per hour of the cell's clock; NaN while the job runs.
    """

    actions: int
    pushes: int
    grasp_attempts: int
    grasp_successes: int
    picked: tuple[str, ...]
    grasp_success_rate: float
    picks_per_hour: float


class Journal:
    """The database of jobs; a context manager.

    Args:
        url: any SQLAlchemy URL, or the path of a SQLite file; the folder of such a file is made.

    Raises:
        ConfigError: the URL is malformed, or the database is not one of this program or of a newer one.
        StorageError: the database cannot be opened or written.
    """

    def __init__(self, url: str | Path) -> None:
        shown = str(url)
        self._file: Path | None = None
        try:
            parsed = URL.create("sqlite", database=str(url)) if isinstance(url, Path) else make_url(url)
            # A URL may hold a password.
            shown = parsed.render_as_string(hide_password=True)
            waiting = {"timeout": _LOCKED_S} if parsed.get_backend_name() == "sqlite" else {}
            self._engine = create_engine(parsed, connect_args=waiting)
        except (ArgumentError, ImportError, SQLAlchemyError) as error:
            raise ConfigError(f"journal.url = {shown!r}: the journal cannot be opened: {_cause(error)}") from error
        try:
            if parsed.get_backend_name() == "sqlite":
                if parsed.database not in {None, "", ":memory:"}:
                    self._file = Path(str(parsed.database))
                    self._file.parent.mkdir(parents=True, exist_ok=True)
                event.listen(self._engine, "connect", _use_write_ahead_log)
            bring_up_to_date(self._engine)
        except BaseException as error:
            self._engine.dispose()
            where = f"journal.url = {shown!r}: the journal cannot be opened:"
            if isinstance(error, ConfigError):
                raise ConfigError(f"{where} {error}") from None
            if isinstance(error, OSError | SQLAlchemyError):
                raise StorageError(f"{where} {_cause(error)}; check folder and database") from error
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the database; idempotent."""
        self._engine.dispose()

    def check_writable(self) -> None:
        """See whether the database takes a row, without leaving one.

        Raises:
            StorageError: it does not.
        """
        with self._writing() as session:
            session.execute(update(Job).where(Job.id == -1).values(reason=""))

    def start_job(
        self,
        goals: Sequence[str] | None,
        policy: str,
        config: dict[str, Any],
        run_dir: Path,
        lock: LockFile | None = None,
    ) -> int:
        """Record that a job starts, in the process that holds `lock`; returns its id."""
        job = Job(
            started=_now(),
            goals=list(goals) if goals else None,
            policy=policy,
            config=config,
            run_dir=str(run_dir),
            lock=lock.name if lock else None,
            owner=owner(lock) if lock else None,
        )
        return self._add(job)

    def resume_job(self, job_id: int, lock: LockFile) -> None:
        """Record that a job goes on, in the process that holds `lock`."""
        with self._writing() as session:
            job = session.get_one(Job, job_id)
            job.status, job.reason, job.ended, job.owner = "running", "", None, owner(lock)

    def end_job(self, job_id: int, status: str, reason: str, cell_s: float) -> None:
        """Record how a job ended."""
        with self._writing() as session:
            job = session.get_one(Job, job_id)
            job.status, job.reason, job.cell_s, job.ended = status, reason, cell_s, _now()

    def add_frame(self, frame: Frame) -> int:
        """Record a frame; returns its id."""
        return self._add(frame)

    def start_action(self, action: ActionRow) -> int:
        """Record that an action starts; returns its id."""
        return self._add(action)

    def held(self, action_id: int, label: str) -> None:
        """Record that the fingers held something at a check of an action that runs."""
        with self._writing() as session:
            session.get_one(ActionRow, action_id).held = label

    def end_action(self, outcome: OutcomeRow, cell_s: float | None = None) -> None:
        """Record what came of an action, in place of what was recorded of it when it was stopped.

        Args:
            outcome: of the action.
            cell_s: how long the job has taken on the cell's clock [s].
        """
        with self._writing() as session:
            session.merge(outcome)
            if cell_s is not None:
                session.get_one(ActionRow, outcome.action_id).job.cell_s = cell_s

    def add_stop(self, stop: StopRow) -> None:
        """Record a stop of a cell."""
        self._add(stop)

    def standing_stop(self, cell: str) -> StopRow | None:
        """The newest stop of a cell that nobody has recovered from."""
        with self._reading() as session:
            standing = select(StopRow).where(StopRow.cell == cell, StopRow.cleared.is_(None))
            return session.scalar(standing.order_by(StopRow.id.desc()).limit(1))

    def clear_stops(self, cell: str) -> None:
        """Record that an operator has recovered a cell."""
        with self._writing() as session:
            for stop in session.scalars(select(StopRow).where(StopRow.cell == cell, StopRow.cleared.is_(None))):
                stop.cleared = _now()

    def newest_job(self, lock: str) -> Job | None:
        """The last job of a cell, by the name of its lock, without its actions."""
        with self._reading() as session:
            return session.scalar(select(Job).where(Job.lock == lock).order_by(Job.id.desc()).limit(1))

    def jobs(self, limit: int = 20) -> list[Job]:
        """The newest jobs first, without their actions."""
        with self._reading() as session:
            return list(session.scalars(select(Job).order_by(Job.id.desc()).limit(limit)))

    def job(self, job_id: int) -> Job:
        """A job with its actions, their frames and outcomes.

        Raises:
            ConfigError: there is none with that id; the message says which ids exist.
        """
        with self._reading() as session:
            job = session.get(Job, job_id)
            if job is None:
                newest = session.scalar(select(func.max(Job.id)))
                known = f"ids run from 1 to {newest}" if newest else "the journal is empty"
                raise ConfigError(f"the journal has no job {job_id}; {known}")
            for action in job.actions:
                _ = action.outcome, action.frame
            return job

    def metrics(self, job_id: int) -> Metrics:
        """The figures of a job, counted over the actions that have an outcome."""
        ended = (
            select(ActionRow.primitive, OutcomeRow.success, OutcomeRow.picked)
            .join(OutcomeRow)
            .where(ActionRow.job_id == job_id, OutcomeRow.result.not_in(NOT_RUN))
            .order_by(ActionRow.id)
        )
        with self._reading() as session:
            rows = session.execute(ended).all()
            cell_s = session.scalar(select(Job.cell_s).where(Job.id == job_id))
        grasps = [row for row in rows if row.primitive == GRASP]
        successes = sum(row.success for row in grasps)
        return Metrics(
            actions=len(rows),
            pushes=len(rows) - len(grasps),
            grasp_attempts=len(grasps),
            grasp_successes=successes,
            picked=tuple(row.picked for row in grasps if row.picked),
            grasp_success_rate=successes / len(grasps) if grasps else float("nan"),
            picks_per_hour=3600 * successes / cell_s if cell_s else float("nan"),
        )

    def _add(self, row: Job | Frame | ActionRow | StopRow) -> int:
        with self._writing() as session:
            session.add(row)
            session.flush()
            return row.id

    @contextmanager
    def _reading(self) -> Iterator[Session]:
        try:
            with Session(self._engine, expire_on_commit=False) as session:
                yield session
        except SQLAlchemyError as error:
            raise ConfigError(f"the journal cannot be read: {_cause(error)}; is it one of this program?") from error

    @contextmanager
    def _writing(self) -> Iterator[Session]:
        if self._file is not None and not self._file.exists():
            # SQLite would go on writing into a file that nobody can open any more.
            raise StorageError(
                f"the journal cannot be written: {self._file} was removed; put it back, then start again"
            )
        try:
            with Session(self._engine, expire_on_commit=False) as session, session.begin():
                yield session
        except SQLAlchemyError as error:
            raise StorageError(f"the journal cannot be written: {_cause(error)}; check disk and database") from error


def _use_write_ahead_log(connection: Any, _record: object) -> None:
    """A reader (`robotcell jobs`) then never blocks a running job, nor a job the reader."""
    cursor = connection.cursor()
    cursor.execute("PRAGMA journal_mode=WAL")
    cursor.execute("PRAGMA foreign_keys=ON")
    cursor.close()


def _cause(error: Exception) -> str:
    """The driver's own words; SQLAlchemy adds the statement and a link."""
    return str(error.orig) if isinstance(error, DBAPIError) else str(error)


def _now() -> datetime:
    return datetime.now(timezone.utc)
