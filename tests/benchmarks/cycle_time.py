"""Where the time of a pick goes, in simulated cell time: `python -m tests.benchmarks.cycle_time --scenes 4 --seed 0`.

Jobs that pick everything on the tables of random scenes, in the in-process twin. In every step of the physics it is
noted what the cell was doing; the table is the mean over the actions that ended with a pick. The arm comes first: while
it moves, what fingers, camera and policy do beside it costs nothing and is not counted.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from policy import make_policy
from robotcell.cell import Cell
from robotcell.config import load_config
from robotcell.interfaces import Devices
from robotcell.jobs.job import run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.verdict import Outcome, Result
from robotcell.motion.actions import plan_action
from robotcell.motion.plan import CheckHold, Grip, JointMove, LinearMove, Shape
from sim_twin.devices.backend import open_twin
from sim_twin.world.simulation import STEP_S

if TYPE_CHECKING:
    from collections.abc import Sequence

    from robotcell.interfaces import Arm, Array, Camera, Gripper, RgbdFrame, Waypoint
    from robotcell.jobs.decision import Decision
    from robotcell.jobs.policy_api import Policy
    from robotcell.motion.plan import Step
    from robotcell.perception.view import View
    from sim_twin.world.world import World

LOOKING, DECIDING, RESTING = "look", "decide", "at rest between"


@dataclass
class Follower:
    """Notes in every step of the physics what the cell does, and splits it by the steps of the plans.

    Attributes:
        seconds: simulated, by phase, of the action under way.
        picks: those of the actions that ended with a pick.
        wall_s: seconds on the wall of each of them.
        peaks_n, grips_n: contact forces of all actions, guarded motions and closing fingers.
        results: of all actions.
    """

    cell: Cell
    world: World
    seconds: Counter[str] = field(default_factory=Counter)
    picks: list[Counter[str]] = field(default_factory=list)
    wall_s: list[float] = field(default_factory=list)
    peaks_n: list[float] = field(default_factory=list)
    grips_n: list[float] = field(default_factory=list)
    results: Counter[str] = field(default_factory=Counter)
    reading: bool = False
    deciding: bool = False
    _steps: tuple[Step, ...] = ()
    _moves: list[Step] = field(default_factory=list)
    _grips: list[Step] = field(default_factory=list)
    _moving: list[tuple[Array, float]] = field(default_factory=list)
    _begun: float = 0.0

    def sample(self) -> None:
        """One step of the physics."""
        arm, gripper = self.cell.arm, self.cell.gripper
        if arm.moving:
            self._moving.append((arm.state().q, self.world.time_s))
            return
        self._close_motion()
        if gripper.state().busy and self._grips:
            self.seconds[self._grips[0].label] += STEP_S
        elif self.deciding:
            self.seconds[DECIDING] += STEP_S
        elif self.reading:
            self.seconds[LOOKING] += STEP_S
        else:
            self.seconds[RESTING] += STEP_S

    def motion_begins(self, legs: int) -> None:
        """A motion of so many steps of the plan was started."""
        self._close_motion()
        self._legs, self._moves = self._moves[:legs], self._moves[legs:]

    def grip_begins(self) -> None:
        """The fingers were sent off."""
        self._grips = self._grips[1:]

    def started(self, _job_id: int, _run_dir: Path) -> None:
        """As the job's observer."""

    def checked(self, _findings: object) -> None:
        """As the job's observer."""

    def looked(self, view: View) -> None:
        """As the job's observer."""

    def decided(self, decision: Decision) -> None:
        """As the job's observer: the plan says what the motions to come are called."""
        plan = plan_action(decision.action, decision.view.heightmap, self.cell.arm.state().q, self.cell.config)
        self._moves = [step for step in plan.steps if isinstance(step, JointMove | LinearMove)]
        # The first command of the fingers takes the entry in front away.
        self._grips = [CheckHold("", 0.0), *(step for step in plan.steps if isinstance(step, Grip | Shape))]

    def ended(self, _decision: Decision, outcome: Outcome) -> None:
        """As the job's observer."""
        self._close_motion()
        if outcome.result is Result.PICKED:
            self.picks.append(self.seconds)
            self.wall_s.append(time.perf_counter() - self._begun)
        self.results[outcome.result.value] += 1
        self.peaks_n.append(outcome.peak_force_n)
        self.grips_n.append(outcome.grip_force_n)
        self.seconds = Counter()
        self._begun = time.perf_counter()

    _legs: list[Step] = field(default_factory=list)

    def _close_motion(self) -> None:
        """Split the motion that has ended where it passed nearest to the targets of its legs."""
        if not self._moving:
            return
        q = np.array([q for q, _ in self._moving])
        begin = 0
        labels = [leg.label for leg in self._legs] or ["other motion"]
        for i, leg in enumerate(self._legs[:-1]):
            off = _distance(q[begin:], leg)
            end = begin + int(off.argmin())
            self.seconds[labels[i]] += (end - begin) * STEP_S
            begin = end
        self.seconds[labels[-1]] += (len(q) - begin) * STEP_S
        self._moving, self._legs = [], []


def _distance(q: Array, leg: Step) -> Array:
    from robotcell.geometry import rg2, ur5e

    assert isinstance(leg, JointMove | LinearMove)
    target = ur5e.forward(leg.q) @ rg2.T_FLANGE_TCP if isinstance(leg, JointMove) else leg.T_base_tcp
    tcp = (ur5e.forward(q) @ rg2.T_FLANGE_TCP)[:, :3, 3]
    return np.asarray(np.linalg.norm(tcp - target[:3, 3], axis=1))


class _Arm:
    """The twin's arm; tells the follower of each motion that begins."""

    def __init__(self, arm: Arm, follower: Follower) -> None:
        self._arm, self._follower = arm, follower

    def __getattr__(self, name: str) -> object:
        return getattr(self._arm, name)

    def start_path(self, waypoints: Sequence[Waypoint]) -> None:
        self._follower.motion_begins(len(waypoints))
        self._arm.start_path(waypoints)


class _Gripper:
    """Likewise the gripper."""

    def __init__(self, gripper: Gripper, follower: Follower) -> None:
        self._gripper, self._follower = gripper, follower

    def __getattr__(self, name: str) -> object:
        return getattr(self._gripper, name)

    def start_width(self, width_m: float, force_n: float) -> None:
        self._follower.grip_begins()
        self._gripper.start_width(width_m, force_n)


class _Camera:
    """Likewise the camera."""

    def __init__(self, camera: Camera, follower: Follower) -> None:
        self._camera, self._follower = camera, follower

    def __getattr__(self, name: str) -> object:
        return getattr(self._camera, name)

    def read(self) -> RgbdFrame:
        self._follower.reading = True
        try:
            return self._camera.read()
        finally:
            self._follower.reading = False


def main() -> None:
    """Run the jobs and print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, default=4, help="jobs, one scene each")
    parser.add_argument("--seed", type=int, default=0, help="of the first scene")
    parser.add_argument("--objects", type=int, default=10, help="in a scene")
    parser.add_argument("--policy", default="learned")
    chosen = parser.parse_args()
    policy: Policy | None = None
    picks: list[Counter[str]] = []
    wall, peaks, grips, rates = [], [], [], []
    results: Counter[str] = Counter()
    for seed in range(chosen.seed, chosen.seed + chosen.scenes):
        config = load_config(
            None, {"backend.name": "twin", "backend.options.objects": chosen.objects, "backend.options.seed": seed}
        )
        policy = policy or make_policy(chosen.policy, config)
        with tempfile.TemporaryDirectory() as folder:
            config = config.model_copy(update={"journal": config.journal.model_copy(update={"runs": Path(folder)})})
            follower, report_rate = _job(config, policy)
        picks += follower.picks
        wall += follower.wall_s
        peaks += follower.peaks_n
        grips += follower.grips_n
        results += follower.results
        rates.append(report_rate)
        _say(f"seed {seed}: {len(follower.picks)} picks, {report_rate:.0f} an hour")
    _print(picks, wall, peaks, grips, results, rates)


def _job(config, policy):  # type: ignore[no-untyped-def]
    plain, world = open_twin(config)
    follower = Follower(plain, world)
    devices = Devices(
        _Arm(plain.arm, follower),  # type: ignore[arg-type]
        _Gripper(plain.gripper, follower),  # type: ignore[arg-type]
        _Camera(plain.camera, follower),  # type: ignore[arg-type]
        plain.clock,
    )
    with Journal("sqlite://") as journal, Cell(config, devices) as cell:
        world.add_controller(follower.sample)
        report = run_job(cell, policy, journal, None, (follower,))
    return follower, report.metrics.picks_per_hour


def _print(picks, wall, peaks, grips, results, rates):  # type: ignore[no-untyped-def]
    total = sum(sum(pick.values()) for pick in picks) / len(picks)
    phases = dict.fromkeys(label for pick in picks for label in pick)
    _say("")
    for phase in phases:
        seconds = sum(pick[phase] for pick in picks) / len(picks)
        _say(f"| {phase} | {seconds:.2f} s | {100 * seconds / total:.0f} % |")
    _say(f"| **a pick** | **{total:.2f} s** | |")
    _say(f"picks: {len(picks)}; actions: {dict(results)}")
    _say(f"picks an hour: {np.mean(rates):.0f} ({min(rates):.0f} to {max(rates):.0f})")
    _say(f"wall time of a pick: median {np.median(wall):.2f} s")
    for what, forces in (("guarded motions", peaks), ("closing fingers", grips)):
        known = np.array([force for force in forces if np.isfinite(force)])
        middle, high, top = np.quantile(known, [0.5, 0.9, 1.0])
        _say(f"contact force of {what}: median {middle:.0f} N, 90 % {high:.0f} N, largest {top:.0f} N")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
