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
from sqlalchemy.engine import make_url
from sqlalchemy.exc import ArgumentError, DBAPIError, SQLAlchemyError
from sqlalchemy.orm import Session

from robotcell.errors import ConfigError, StorageError
from robotcell.jobs.journal_schema import bring_up_to_date
from robotcell.jobs.journal_tables import GRASP, ActionRow, Frame, Job, OutcomeRow

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from typing_extensions import Self


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
        url: any SQLAlchemy URL; the folder of a SQLite file is made.

    Raises:
        ConfigError: the URL is malformed, or the database is not one of this program or of a newer one.
        StorageError: the database cannot be opened or written.
    """

    def __init__(self, url: str) -> None:
        shown = url
        try:
            parsed = make_url(url)
            # A URL may hold a password.
            shown = parsed.render_as_string(hide_password=True)
            self._engine = create_engine(parsed)
        except (ArgumentError, ImportError, SQLAlchemyError) as error:
            raise ConfigError(f"journal.url = {shown!r}: the journal cannot be opened: {_cause(error)}") from error
        try:
            if parsed.get_backend_name() == "sqlite":
                if parsed.database not in {None, "", ":memory:"}:
                    Path(str(parsed.database)).parent.mkdir(parents=True, exist_ok=True)
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

    def start_job(self, goals: Sequence[str] | None, policy: str, config: dict[str, Any], run_dir: Path) -> int:
        """Record that a job starts; returns its id."""
        job = Job(
            started=_now(),
            goals=list(goals) if goals else None,
            policy=policy,
            config=config,
            run_dir=str(run_dir),
        )
        return self._add(job)

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

    def end_action(self, outcome: OutcomeRow) -> None:
        """Record what came of an action."""
        with self._writing() as session:
            session.add(outcome)

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

    def _add(self, row: Job | Frame | ActionRow) -> int:
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
