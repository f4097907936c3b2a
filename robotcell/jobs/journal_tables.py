"""The tables of the journal, and their rows from what a job knows.

A change here needs a revision in `robotcell/jobs/migrations`, and its number in `SCHEMA_REVISION`.
"""

from __future__ import annotations

import math
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import JSON, ForeignKey
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship

from robotcell.jobs.policy_api import PickAny, PickGoal, Task, Uncover
from robotcell.motion.grasp import Grasp
from robotcell.motion.push import Push

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.interfaces import RgbdFrame
    from robotcell.jobs.verdict import Outcome
    from robotcell.motion.actions import Action
    from robotcell.perception.heightmap import Heightmap

SCHEMA_REVISION = "0003"
GRASP, PUSH = "grasp", "push"
ANY, GOAL, UNCOVER = "any", "goal", "uncover"
_TASKS: dict[type[Task], str] = {PickAny: ANY, PickGoal: GOAL, Uncover: UNCOVER}


class Base(DeclarativeBase):
    """Of every table."""


class Job(Base):
    """One call of pick-goal or pick-all."""

    __tablename__ = "jobs"

    # The job's number.
    id: Mapped[int] = mapped_column(primary_key=True)
    # UTC.
    started: Mapped[datetime]
    # UTC; null while the job runs, and of one that was interrupted.
    ended: Mapped[datetime | None]
    # Colours in order, or null for pick-all.
    goals: Mapped[list[str] | None] = mapped_column(JSON)
    # Who decided.
    policy: Mapped[str]
    # Every setting of the cell but journal.url, which may hold a password.
    config: Mapped[dict[str, Any]] = mapped_column(JSON)
    # Folder of the run.
    run_dir: Mapped[str]
    # running, complete, incomplete, stopped, or refused (before it began: what was wrong is the reason). A job that was
    # killed stays at running; its lock tells.
    status: Mapped[str] = mapped_column(default="running")
    # Why it is not complete.
    reason: Mapped[str] = mapped_column(default="")
    # Duration on the cell's clock up to the end of the last action, or of the job [s].
    cell_s: Mapped[float | None]
    # Name of the lock that its process holds, which names the cell too; null where it holds none.
    lock: Mapped[str | None]
    # Which of the lock's holders its process is, as computer/token.
    owner: Mapped[str | None]
    actions: Mapped[list[ActionRow]] = relationship(back_populates="job", order_by="ActionRow.id")


class Frame(Base):
    """A frame that a decision was made on, by reference to its files."""

    __tablename__ = "frames"

    # The frame's number in the journal.
    id: Mapped[int] = mapped_column(primary_key=True)
    # The job that it belongs to.
    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"))
    # The camera's own number.
    number: Mapped[int]
    # Time of the capture on the cell's clock [s].
    t: Mapped[float]
    # PNG, RGB.
    color_file: Mapped[str]
    # PNG, 16 bit, 0.1 mm; 0 = no return.
    depth_file: Mapped[str]
    # Share of the map's cells into which a return fell.
    coverage: Mapped[float]
    # Tilt of the table as it was measured.
    tilt_rad: Mapped[float]
    # Height of the table over the configured one, as it was measured.
    offset_m: Mapped[float]


class ActionRow(Base):
    """An action, committed before it starts."""

    __tablename__ = "actions"

    # The action's number in the journal.
    id: Mapped[int] = mapped_column(primary_key=True)
    # The job that it belongs to.
    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"))
    # The frame that it was decided on.
    frame_id: Mapped[int] = mapped_column(ForeignKey("frames.id"))
    # The word of the goal that it was for; null for any object.
    goal: Mapped[str | None]
    # What was to be done: any (pick any object), goal (pick the goal) or uncover; null of older journals.
    task: Mapped[str | None]
    # grasp or push.
    primitive: Mapped[str]
    # Index k of the direction: k * 22.5 degrees about base z.
    rotation: Mapped[int]
    # Of a grasp its middle, of a push its start; base frame [m].
    x: Mapped[float]
    # See x.
    y: Mapped[float]
    # Height above the table [m]: of the surface that is grasped, or of the top of what is pushed.
    surface_m: Mapped[float]
    # Where a push ends, base frame [m]; null for grasps, and for pushes of the first schema.
    end_x: Mapped[float | None]
    # See end_x.
    end_y: Mapped[float | None]
    # What the policy expected of it.
    q_value: Mapped[float]
    # Time of the start on the cell's clock [s].
    started_s: Mapped[float]
    # The last check at which the fingers held something, such as held over the bin; null before the first.
    held: Mapped[str | None]
    job: Mapped[Job] = relationship(back_populates="actions")
    frame: Mapped[Frame] = relationship()
    outcome: Mapped[OutcomeRow | None] = relationship(back_populates="action")


class OutcomeRow(Base):
    """What came of an action, committed after it ended; an action without one was cut off."""

    __tablename__ = "outcomes"

    # The action that it is of.
    action_id: Mapped[int] = mapped_column(ForeignKey("actions.id"), primary_key=True)
    # In a word, such as picked or missed.
    result: Mapped[str]
    # Whether the action did what it was for.
    success: Mapped[bool]
    # Colour of the object that left the table.
    picked: Mapped[str | None]
    # In a sentence.
    detail: Mapped[str]
    # Largest contact force of guarded motions; null where it is not known.
    peak_force_n: Mapped[float | None]
    # Largest contact force while the fingers gripped; null where they did not, or it is not known.
    grip_force_n: Mapped[float | None]
    # Time of the end on the cell's clock [s].
    ended_s: Mapped[float]
    action: Mapped[ActionRow] = relationship(back_populates="outcome")


class StopRow(Base):
    """A stop of a cell, after which nothing moves until an operator asks for robotcell recover."""

    __tablename__ = "stops"

    # The stop's number.
    id: Mapped[int] = mapped_column(primary_key=True)
    # Name of the cell.
    cell: Mapped[str]
    # What happened.
    what: Mapped[str]
    # UTC.
    at: Mapped[datetime]
    # Joint angles that were measured when the arm stood [rad]; null where they could not be.
    q: Mapped[list[float] | None] = mapped_column(JSON)
    # The job that was stopped; null outside of jobs.
    job_id: Mapped[int | None] = mapped_column(ForeignKey("jobs.id"))
    # When an operator recovered the cell, UTC; null as long as the stop stands.
    cleared: Mapped[datetime | None]


def frame_row(job_id: int, frame: RgbdFrame, heightmap: Heightmap, files: tuple[Path, Path]) -> Frame:
    """The row of a frame; `files` hold its colour and its depth."""
    table = heightmap.table
    return Frame(
        job_id=job_id,
        number=frame.number,
        t=frame.t,
        color_file=str(files[0]),
        depth_file=str(files[1]),
        coverage=heightmap.coverage,
        tilt_rad=table.tilt_rad if table else math.nan,
        offset_m=table.offset_m if table else math.nan,
    )


def action_row(job_id: int, frame_id: int, goal: str | None, task: Task, action: Action, started_s: float) -> ActionRow:
    """The row of an action for a task, which starts at `started_s` on the cell's clock."""
    common = {
        "job_id": job_id,
        "frame_id": frame_id,
        "goal": goal,
        "task": _TASKS[type(task)],
        "rotation": action.rotation,
        "q_value": action.q_value,
        "started_s": started_s,
    }
    if isinstance(action, Grasp):
        return ActionRow(primitive=GRASP, x=action.x, y=action.y, surface_m=action.surface_m, **common)
    (x, y), (end_x, end_y) = action.start, action.end
    return ActionRow(primitive=PUSH, x=x, y=y, surface_m=action.top_m, end_x=end_x, end_y=end_y, **common)


def action_of(row: ActionRow) -> Action | None:
    """The action of a row; None for a push of the first schema, whose end is not known."""
    if row.primitive == GRASP:
        return Grasp(row.x, row.y, row.surface_m, row.rotation, row.q_value)
    if row.end_x is None or row.end_y is None:
        return None
    return Push((row.x, row.y), (row.end_x, row.end_y), row.rotation, row.surface_m, row.q_value)


def outcome_row(action_id: int, outcome: Outcome, ended_s: float) -> OutcomeRow:
    """The row of what came of an action that ended at `ended_s` on the cell's clock."""
    return OutcomeRow(
        action_id=action_id,
        result=outcome.result.value,
        success=outcome.success,
        picked=outcome.picked,
        detail=outcome.detail,
        peak_force_n=_known(outcome.peak_force_n),
        grip_force_n=_known(outcome.grip_force_n),
        ended_s=ended_s,
    )


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
