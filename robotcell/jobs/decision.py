"""A decision about to be run, and who follows a job."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from robotcell.findings import Finding
    from robotcell.jobs.policy_api import Task
    from robotcell.jobs.verdict import Outcome
    from robotcell.motion.actions import Action
    from robotcell.motion.path_check import CheckedPlan
    from robotcell.perception.view import View


@dataclass(frozen=True)
class Decision:
    """An action about to be run.

    Attributes:
        index: number of the action in its job, from 1.
        goal: the word of the goal that it is for; None for any object.
        view: what it was decided on.
        task: what was to be done.
        action: grasp or push.
    """

    index: int
    goal: str | None
    view: View
    task: Task
    action: Action


class Hold(Protocol):
    """Lets an operator hold a job between two of its actions, while the arm stands still and the gripper is empty."""

    def __call__(self) -> bool:
        """Return at once, or wait until the job may go on; whether it waited, and the table may have changed."""
        ...


class Confirm(Protocol):
    """Asks somebody before an action is run."""

    def __call__(self, decision: Decision, checked: CheckedPlan) -> bool:
        """Whether the plan of a decision, which was found safe, shall run; if not, another action is decided."""
        ...


class Observer(Protocol):
    """Follows a job."""

    def started(self, job_id: int, run_dir: Path) -> None:
        """The job is in the journal and its folder is made."""
        ...

    def checked(self, findings: Sequence[Finding]) -> None:
        """The preflight is over; a job that it refuses ends now."""
        ...

    def looked(self, view: View) -> None:
        """The camera was read."""
        ...

    def decided(self, decision: Decision) -> None:
        """An action is about to run."""
        ...

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """An action ended."""
        ...
