"""What the arm is about while the guard watches it: the phase, the path that was checked, and what is held."""

from __future__ import annotations

import enum
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from robotcell.motion.plan import JointMove, is_guarded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.geometry.transforms import Array
    from robotcell.motion.plan import LinearMove

# A straight motion is solved for joints by this program and by the controller, whose kinematics differ from the nominal
# ones by up to a centimetre: a fifth of this at the arm's reach. A joint motion needs no solving.
_LINE_OFF_RAD, _JOINTS_OFF_RAD = 0.1, 0.05


class Phase(enum.Enum):
    """What contact forces mean."""

    FREE = "free motion"  # nothing is touched
    CARRY = "carry"  # nothing is touched but what is held
    GUARDED = "guarded motion"  # a descent or a push: a contact is looked for, and ends it
    GRIP = "grip"  # the fingers press on what they take, and on what lies beneath


@dataclass(frozen=True)
class Course:
    """What the arm does now.

    Attributes:
        label: of the step.
        phase: what contact forces mean.
        path: joint angles (N, 6) [rad] along it as they were checked.
        off_rad: how far a joint may be from the path.
        lowest_tip_m: height above the table that the finger tips may go down to [m].
        load_m: how far a held object reaches below the tcp.
    """

    label: str
    phase: Phase
    path: Array
    off_rad: float
    lowest_tip_m: float
    load_m: float = 0.0

    def distance(self, q: Array) -> float:
        """How far joints (6,) [rad] are from the nearest place on the path: the largest difference of a joint."""
        start, way, scaled = self._legs
        share = np.einsum("ij,ij->i", q - start, scaled)
        nearest = start + np.clip(share, 0.0, 1.0)[:, None] * way
        return float(np.abs(nearest - q).max(axis=1).min())

    @cached_property
    def _legs(self) -> tuple[Array, Array, Array]:
        """Starts and ways (M, 6) of the legs of the path, and the ways over their squared lengths."""
        start = self.path[:-1] if len(self.path) > 1 else self.path
        way = np.diff(self.path, axis=0) if len(self.path) > 1 else np.zeros_like(self.path)
        length2 = np.einsum("ij,ij->i", way, way)[:, None]
        return start, way, way / np.where(length2 > 0, length2, 1.0)


def course_of(moves: Sequence[JointMove | LinearMove], path: Array, lowest_tip_m: float) -> Course:
    """That of a motion, or of several that are blended, checked as path (N, 6) [rad].

    How a controller rounds a corner is its own affair, so blended motions are held to the wider bound.
    """
    last, load_m = moves[-1], max(move.load_m for move in moves)
    not_guarded = Phase.CARRY if load_m > 0 else Phase.FREE
    phase = Phase.GUARDED if is_guarded(last) else not_guarded
    off = _JOINTS_OFF_RAD if len(moves) == 1 and isinstance(last, JointMove) else _LINE_OFF_RAD
    return Course(last.label, phase, path, off, lowest_tip_m, load_m)


def standing(label: str, q: Array, lowest_tip_m: float) -> Course:
    """That of an arm that stands at q (6,) [rad] while its fingers move."""
    return Course(label, Phase.GRIP, q[None], _JOINTS_OFF_RAD, lowest_tip_m)
