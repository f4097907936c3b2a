"""The tables of the journal, and their rows from what a job knows.

A change here needs a revision in `robotcell/jobs/migrations`, and its number in `SCHEMA_REVISION`.
"""

from __future__ import annotations

import math
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sqlalchemy import JSON, ForeignKey
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column, relationship

from robotcell.motion.grasp import Grasp

if TYPE_CHECKING:
    from pathlib import Path

    from robotcell.interfaces import RgbdFrame
    from robotcell.jobs.verdict import Outcome
    from robotcell.motion.actions import Action
    from robotcell.perception.heightmap import Heightmap

SCHEMA_REVISION = "0002"
GRASP, PUSH = "grasp", "push"


class Base(DeclarativeBase):
    """Of every table."""


class Job(Base):
    """One call of pick-goal or pick-all."""

    __tablename__ = "jobs"

    id: Mapped[int] = mapped_column(primary_key=True)
    started: Mapped[datetime]
    ended: Mapped[datetime | None]
    # Colours in order, or null for pick-all.
    goals: Mapped[list[str] | None] = mapped_column(JSON)
    policy: Mapped[str]
    config: Mapped[dict[str, Any]] = mapped_column(JSON)
    run_dir: Mapped[str]
    # running, complete, incomplete or stopped
    status: Mapped[str] = mapped_column(default="running")
    reason: Mapped[str] = mapped_column(default="")
    # Duration on the cell's clock.
    cell_s: Mapped[float | None]
    actions: Mapped[list[ActionRow]] = relationship(back_populates="job", order_by="ActionRow.id")


class Frame(Base):
    """A frame that a decision was made on, by reference to its files."""

    __tablename__ = "frames"

    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"))
    number: Mapped[int]
    t: Mapped[float]
    color_file: Mapped[str]
    depth_file: Mapped[str]
    coverage: Mapped[float]
    tilt_rad: Mapped[float]
    offset_m: Mapped[float]


class ActionRow(Base):
    """An action, committed before it starts."""

    __tablename__ = "actions"

    id: Mapped[int] = mapped_column(primary_key=True)
    job_id: Mapped[int] = mapped_column(ForeignKey("jobs.id"))
    frame_id: Mapped[int] = mapped_column(ForeignKey("frames.id"))
    goal: Mapped[str | None]
    primitive: Mapped[str]
    rotation: Mapped[int]
    # Of a grasp its middle, of a push its start; base frame.
    x: Mapped[float]
    y: Mapped[float]
    # Height above the table: of the surface that is grasped, or of the top of what is pushed.
    surface_m: Mapped[float]
    # Of a push only, and not known of pushes of the first schema.
    end_x: Mapped[float | None]
    end_y: Mapped[float | None]
    q_value: Mapped[float]
    started_s: Mapped[float]
    job: Mapped[Job] = relationship(back_populates="actions")
    frame: Mapped[Frame] = relationship()
    outcome: Mapped[OutcomeRow | None] = relationship(back_populates="action")


class OutcomeRow(Base):
    """What came of an action, committed after it ended; an action without one was cut off."""

    __tablename__ = "outcomes"

    action_id: Mapped[int] = mapped_column(ForeignKey("actions.id"), primary_key=True)
    result: Mapped[str]
    success: Mapped[bool]
    # Colour of the object that left the table.
    picked: Mapped[str | None]
    detail: Mapped[str]
    # Contact forces of guarded motions and of the fingers; null where they are not known.
    peak_force_n: Mapped[float | None]
    grip_force_n: Mapped[float | None]
    ended_s: Mapped[float]
    action: Mapped[ActionRow] = relationship(back_populates="outcome")


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


def action_row(job_id: int, frame_id: int, goal: str | None, action: Action, started_s: float) -> ActionRow:
    """The row of an action that starts at `started_s` on the cell's clock."""
    common = {
        "job_id": job_id,
        "frame_id": frame_id,
        "goal": goal,
        "rotation": action.rotation,
        "q_value": action.q_value,
        "started_s": started_s,
    }
    if isinstance(action, Grasp):
        return ActionRow(primitive=GRASP, x=action.x, y=action.y, surface_m=action.surface_m, **common)
    (x, y), (end_x, end_y) = action.start, action.end
    return ActionRow(primitive=PUSH, x=x, y=y, surface_m=action.top_m, end_x=end_x, end_y=end_y, **common)


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
