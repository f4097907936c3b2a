"""One trial of the benchmark: a job in the twin, and what came of it by the journal and by the simulator's truth."""

from __future__ import annotations

import shlex
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field, replace
from itertools import count
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

import cv2

from policy import make_policy
from robotcell.config import BackendChoice, JournalPlace
from robotcell.errors import CellError
from robotcell.jobs.job import run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.pictures import describe, draw_decision, draw_view
from robotcell.jobs.verdict import Result
from robotcell.perception.colors import PALETTE
from sim_twin.devices.backend import open_twin

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

    from policy.evaluation.suites import Case
    from robotcell.cell import Cell
    from robotcell.config import CellConfig
    from robotcell.findings import Finding
    from robotcell.jobs.decision import Decision
    from robotcell.jobs.policy_api import Action, Observation, Policy
    from robotcell.jobs.verdict import Outcome
    from robotcell.perception.view import View
    from sim_twin.world.world import World

# Apart by more than any benchmark has trials, so that a redrawn scene is no other trial's.
_REDRAW_STRIDE = 1_000_000
_REDRAWS = 10
_PICTURES = 3
_PICTURE_WIDTH_PX = 800
_JPEG_QUALITY = 80
_BAD = (150, 40, 30)


@dataclass(frozen=True)
class Trial:
    """One job that is to be run.

    Attributes:
        suite: name of its suite.
        case: the scene and the request.
        seed: of the scene and of the camera's noise.
        policy: who decides.
        config: the cell; scene, policy and journal of the trial stand above its own.
        cell_file: where that came from, for the command that runs the trial again.
        settings: what `--set` said above it, likewise.
    """

    suite: str
    case: Case
    seed: int
    policy: str
    config: CellConfig
    cell_file: str | None = None
    settings: tuple[str, ...] = ()

    @property
    def key(self) -> tuple[str, str, int, str]:
        """What tells it from every other trial of a benchmark."""
        return self.suite, self.case.label, self.seed, self.policy


@dataclass(frozen=True)
class Failure:
    """What went wrong at one point of a trial.

    Attributes:
        action: what was tried, in words.
        result: a `robotcell.jobs.verdict.Result`, or "not complete" of a trial that ended without a failed action.
        detail: why.
        picture: name of the picture's file.
    """

    action: str
    result: str
    detail: str
    picture: str


@dataclass(frozen=True)
class TrialResult:
    """What came of a trial.

    Attributes:
        suite, scene, seed, policy: the trial.
        goal: colour, or None for everything.
        scene_seed: the seed whose scene was played; another one where the goal of the first lay buried.
        command: runs the trial again.
        objects: how many the scene has.
        completed: what the job says.
        true_completed: what the simulator says: an object of the goal's colour, or every object, lies in the bin.
        reason: why the job ended where it is not complete.
        actions, pushes, grasp_attempts, grasp_successes: as in `robotcell.jobs.journal.Metrics`.
        failures: how often each result that is no success occurred.
        shown: failures with pictures: the first two and the last.
        simulated_s: on the cell's clock.
        wall_s: on this machine's.
        decision_s: median wall time of a decision, None without one.
    """

    suite: str
    scene: str
    seed: int
    policy: str
    goal: str | None
    scene_seed: int
    command: str
    objects: int = 0
    completed: bool = False
    true_completed: bool = False
    reason: str = ""
    actions: int = 0
    pushes: int = 0
    grasp_attempts: int = 0
    grasp_successes: int = 0
    failures: dict[str, int] = field(default_factory=dict)
    shown: tuple[Failure, ...] = ()
    simulated_s: float = 0.0
    wall_s: float = 0.0
    decision_s: float | None = None

    @property
    def key(self) -> tuple[str, str, int, str]:
        """`Trial.key`."""
        return self.suite, self.scene, self.seed, self.policy


def run_trial(trial: Trial) -> tuple[TrialResult, dict[str, bytes]]:
    """Run a trial; its result, and the pictures (JPEG) by the names of their files.

    A scene that the seed draws is drawn anew while its goal lies buried under the obstacles: a goal that nobody sees
    cannot be asked for. Every policy meets the same scenes, since nothing was moved by then.

    An error that stops the cell is a result. Anything else is a defect and is raised.
    """
    for redraw in count():
        scene_seed = trial.seed + redraw * _REDRAW_STRIDE
        result, watcher = _play(trial, scene_seed)
        if trial.case.objects is None or not watcher.goal_is_buried or redraw == _REDRAWS:
            return result, watcher.pictures
    raise AssertionError("count() does not end")


def _play(trial: Trial, scene_seed: int) -> tuple[TrialResult, _Watcher]:
    started = time.perf_counter()
    result = TrialResult(*trial.key, trial.case.goal, scene_seed, _command(trial, scene_seed))
    with tempfile.TemporaryDirectory(prefix="robotcell-bench-") as folder:
        config = _config(trial, scene_seed, Path(folder))
        watcher = _Watcher(config, trial)
        cell, world = open_twin(config)
        try:
            with Journal(config.journal.database_url()) as journal, cell:
                result = _work(result, cell, world, journal, watcher)
        except CellError as error:
            # The cell could not be opened, or the job not begin.
            result = replace(result, reason=str(error), failures={Result.STOPPED.value: 1})
    if not result.completed and not watcher.failures:
        watcher.show_end(result.reason)
    return replace(result, shown=tuple(watcher.failures), wall_s=time.perf_counter() - started), watcher


def _work(result: TrialResult, cell: Cell, world: World, journal: Journal, watcher: _Watcher) -> TrialResult:
    policy = _Timed(make_policy(result.policy, cell.config))
    stopped = False
    try:
        report = run_job(cell, policy, journal, (result.goal,) if result.goal else None, (watcher,))
        completed, reason = report.completed, report.reason
    except CellError as error:
        if watcher.job_id is None:
            raise
        completed, reason, stopped = False, str(error), True
    assert watcher.job_id is not None, "a job that ran has started"
    job, metrics = journal.job(watcher.job_id), journal.metrics(watcher.job_id)
    outcomes = [action.outcome for action in job.actions if action.outcome is not None]
    failures = Counter(outcome.result for outcome in outcomes if not outcome.success)
    if stopped:
        # Between two actions it has no row of its own.
        failures[Result.STOPPED.value] = 1
    in_bin = [(item.color, world.in_bin(index)) for index, (item, _) in enumerate(world.objects())]
    picked = [inside for color, inside in in_bin if result.goal is None or color == PALETTE[result.goal]]
    return replace(
        result,
        objects=len(in_bin),
        completed=completed,
        true_completed=all(picked) if result.goal is None else any(picked),
        reason=reason,
        actions=metrics.actions,
        pushes=metrics.pushes,
        grasp_attempts=metrics.grasp_attempts,
        grasp_successes=metrics.grasp_successes,
        failures=dict(failures),
        simulated_s=job.cell_s or 0.0,
        decision_s=median(policy.decisions_s) if policy.decisions_s else None,
    )


def _config(trial: Trial, scene_seed: int, folder: Path) -> CellConfig:
    case, backend = trial.case, trial.config.backend
    drawn = {} if case.objects is None else {"objects": case.objects}
    options = backend.options | {"scene": case.scene, "seed": scene_seed, "meshes": case.meshes} | drawn
    return trial.config.model_copy(
        update={
            "backend": BackendChoice(name=backend.name, options=options),
            "journal": JournalPlace(runs=folder),
            "policy": trial.config.policy.model_copy(update={"name": trial.policy}),
        }
    )


def _command(trial: Trial, scene_seed: int) -> str:
    case = trial.case
    words = ["robotcell", "pick", *(("--goal", case.goal) if case.goal else ("--all",)), "--scene", case.scene]
    if case.meshes is not None:
        words += ["--meshes", case.meshes]
    if case.objects is not None:
        words += ["--objects", str(case.objects)]
    words += ["--seed", str(scene_seed), "--policy", trial.policy]
    if trial.cell_file is not None:
        words += ["--cell", trial.cell_file]
    for setting in trial.settings:
        words += ["--set", setting]
    return shlex.join(words)


class _Timed:
    """A policy that notes how long it thinks."""

    def __init__(self, policy: Policy) -> None:
        self._policy = policy
        self.name = policy.name
        self.workspace = policy.workspace
        self.decisions_s: list[float] = []

    def decide(self, observation: Observation) -> Action:
        started = time.perf_counter()
        action = self._policy.decide(observation)
        self.decisions_s.append(time.perf_counter() - started)
        return action


@dataclass
class _Watcher:
    """An observer of the job that draws failures."""

    config: CellConfig
    trial: Trial
    job_id: int | None = None
    failures: list[Failure] = field(default_factory=list)
    pictures: dict[str, bytes] = field(default_factory=dict)
    goal_is_buried: bool = False
    view: View | None = None

    def started(self, job_id: int, run_dir: Path) -> None:
        """Take the number of the job."""
        self.job_id = job_id

    def checked(self, findings: Sequence[Finding]) -> None:
        """A trial that is refused says so by its error."""

    def looked(self, view: View) -> None:
        """Keep the newest view; see by the first one whether the goal can be asked for."""
        goal = self.trial.case.goal
        if self.view is None and goal is not None:
            self.goal_is_buried = goal not in {instance.color_name for instance in view.segmentation.instances}
        self.view = view

    def decided(self, decision: Decision) -> None:
        """Nothing has failed yet."""

    def ended(self, decision: Decision, outcome: Outcome) -> None:
        """Draw an action that failed; of many, the first ones and the last."""
        if not outcome.success:
            del self.failures[_PICTURES - 1 :]
            page = draw_decision(decision, self.config, f"{describe(decision)}: {outcome.result.value}", _BAD)
            self._show(describe(decision), outcome.result.value, outcome.detail, page)

    def show_end(self, reason: str) -> None:
        """Draw the table as a job left it that ended without a failed action."""
        if self.view is not None:
            page = draw_view(self.view, None, None, self.config, "not complete", _BAD)
            self._show("the table at the end", "not complete", reason, page)

    def _show(self, action: str, result: str, detail: str, page: npt.NDArray[np.uint8]) -> None:
        trial = self.trial
        stem = f"{trial.suite}-{trial.case.label}-{trial.seed}-{trial.policy}-{len(self.failures) + 1}"
        name = "".join(letter if letter.isalnum() or letter in "-_." else "_" for letter in stem) + ".jpg"
        height = round(page.shape[0] * _PICTURE_WIDTH_PX / page.shape[1])
        small = cv2.resize(page, (_PICTURE_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
        bgr = cv2.cvtColor(small, cv2.COLOR_RGB2BGR)
        _, jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self.pictures[name] = jpeg.tobytes()
        self.failures.append(Failure(action, result, detail, name))
