"""Jobs that were cut off: what of them holds for the next process, and how they go on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from policy import make_policy
from robotcell.cell import Cell
from robotcell.config import CellConfig, Workspace, load_config
from robotcell.errors import ConfigError, GuardTripped, StorageError
from robotcell.io.lock_file import LockFile
from robotcell.jobs.job import resume_job, run_job
from robotcell.jobs.journal import Journal
from robotcell.jobs.journal_tables import ActionRow, OutcomeRow, action_of, action_row, outcome_row
from robotcell.jobs.opening import JournalStops
from robotcell.jobs.ownership import Life, life
from robotcell.jobs.policy_api import PickAny, Uncover
from robotcell.jobs.progress import Progress
from robotcell.jobs.resuming import replay
from robotcell.jobs.verdict import Outcome, Result
from robotcell.motion.grasp import Grasp
from robotcell.motion.guard import Latch
from robotcell.motion.push import Push
from robotcell.perception.colors import PALETTE
from sim_twin.devices.backend import open_twin

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from sim_twin.world.world import World

SCENE = """
name = "two cubes"
drop = false
[[object]]
name = "one"
shape = "cube"
color = "red"
position = [0.0, 0.06, 0.025]
[[object]]
name = "other"
shape = "cube"
color = "blue"
position = [0.0, -0.06, 0.025]
"""
NAME = "arm-192.168.1.10"


@pytest.fixture
def config(tmp_path: Path) -> CellConfig:
    scene = tmp_path / "two-cubes.toml"
    scene.write_text(SCENE)
    return load_config(None, {"backend.options.scene": str(scene), "journal.runs": str(tmp_path / "runs")})


@pytest.fixture(autouse=True)
def _own_locks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture
def opened(config: CellConfig) -> Iterator[tuple[Cell, World]]:
    """A twin with the lock and the stops of a cell that lasts, as it is for one process after the other."""
    with Twin(config) as cell:
        yield cell


class Twin:
    """A twin as a process finds it; the world is another one each time."""

    def __init__(self, config: CellConfig) -> None:
        bare, self._world = open_twin(config)
        store = JournalStops(config.journal, NAME)
        self._cell = Cell(config, bare.devices, Latch(store), LockFile(NAME), lasting=True)

    def __enter__(self) -> tuple[Cell, World]:
        return self._cell.__enter__(), self._world

    def __exit__(self, *exception: Any) -> None:
        self._cell.__exit__(*exception)


def interrupt(monkeypatch: pytest.MonkeyPatch, device: object, name: str, call: int) -> None:
    """From now on the so many-th call of a method is where Ctrl-C comes."""
    method, calls = getattr(device, name), 0

    def counted(*arguments: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == call:
            monkeypatch.setattr(device, name, method)
            raise KeyboardInterrupt
        return method(*arguments)

    monkeypatch.setattr(device, name, counted)


def turned(config: CellConfig, angle_rad: float) -> list[float]:
    """The home pose, its first joint turned."""
    first, *others = config.motion.home_q
    return [first + angle_rad, *others]


def test_a_stop_outlives_the_process_and_only_recovery_ends_it(
    config: CellConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Twin(config) as (cell, _):
        interrupt(monkeypatch, cell.arm, "kick", 30)
        with pytest.raises(KeyboardInterrupt):
            cell.move(joints=turned(config, 0.3))
    with Twin(config) as (cell, _):
        assert cell.latch.stop is not None
        assert "KeyboardInterrupt" in cell.latch.stop.what
        assert cell.latch.stop.q is not None
        with pytest.raises(GuardTripped, match="robotcell recover"):
            cell.home()
        with Journal(config.journal.database_url()) as journal, pytest.raises(GuardTripped, match="robotcell recover"):
            run_job(cell, make_policy("heuristic", config), journal, None)
        cell.recover()
    with Twin(config) as (cell, _):
        assert cell.latch.stop is None
        cell.home()


def test_recovery_goes_home_slowly_with_what_the_fingers_hold(opened: tuple[Cell, World]) -> None:
    cell, _world = opened
    home = np.array(cell.config.motion.home_q)
    cell.move(joints=turned(cell.config, 0.1))
    cell.grip(0.04)
    cell.latch.trip("somebody pressed Ctrl-C")
    fastest, width = 0.0, cell.gripper.state().width_m
    kick = cell.arm.kick

    class Watched:
        def __getattr__(self, name: str) -> Any:
            return getattr(cell.arm, name)

        def kick(self) -> None:
            nonlocal fastest
            fastest = max(fastest, float(np.abs(cell.arm.state().qd).max()))
            kick()

    watched: Any = Watched()
    devices = type(cell.devices)(watched, cell.gripper, cell.camera, cell.clock)
    Cell(cell.config, devices, cell.latch).recover()
    np.testing.assert_allclose(cell.arm.state().q, home, atol=0.01)
    assert 0.1 < fastest < 0.25
    assert cell.gripper.state().width_m == pytest.approx(width, abs=1e-3)
    assert cell.latch.stop is None


def test_a_stop_that_cannot_be_recorded_holds_and_says_so(
    config: CellConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "runs").write_text("a file where the folder should be")
    with Twin(config) as (cell, _):
        monkeypatch.setattr(cell.arm, "start_path", lambda _: None)  # an arm that does not obey
        with pytest.raises(GuardTripped, match=r"ended .* from its target.*the stop could not be recorded"):
            cell.move(joints=turned(config, 0.3))
        with pytest.raises(GuardTripped, match="nothing moves"):
            cell.home()


# A grasp takes some 1000 kicks: its lift from 460 to 560, the way to the bin to 720, the release to 790.
@pytest.mark.parametrize(
    "instants",
    [
        (560, 90),  # in the lift, and again with the object on the way to the bin
        (760,),  # as the fingers open over the bin
    ],
    ids=["carried", "released"],
)
def test_what_was_cut_off_is_counted_once(
    config: CellConfig,
    opened: tuple[Cell, World],
    monkeypatch: pytest.MonkeyPatch,
    instants: tuple[int, ...],
) -> None:
    cell, world = opened
    policy = make_policy("heuristic", config)
    with Journal(config.journal.database_url()) as journal:
        for number, instant in enumerate(instants):
            interrupt(monkeypatch, cell.arm, "kick", instant)
            with pytest.raises(KeyboardInterrupt):
                resume_job(cell, policy, journal, 1) if number else run_job(cell, policy, journal, ("red",))
            assert journal.job(1).status == "stopped"
            cell.recover()
        report = resume_job(cell, policy, journal, 1)
        rows = journal.job(1).actions
    assert report.completed, report.reason
    assert [row.outcome.result for row in rows if row.outcome] == ["picked"]
    assert report.metrics.picked == ("red",)
    in_bin = [item.color for index, (item, _) in enumerate(world.objects()) if world.in_bin(index)]
    assert in_bin == [PALETTE["red"]]


def test_a_job_goes_on_where_it_can_and_nowhere_else(config: CellConfig, opened: tuple[Cell, World]) -> None:
    cell, _ = opened
    policy = make_policy("heuristic", config)
    assert cell.lock is not None
    with Journal(config.journal.database_url()) as journal:
        first = journal.start_job(("red",), policy.name, {}, config.journal.runs / "a", LockFile(NAME))
        second = journal.start_job(("red",), policy.name, {}, config.journal.runs / "b", LockFile(NAME))
        aside = journal.start_job(("red",), policy.name, {}, config.journal.runs / "c", LockFile("process-1"))
        assert [life(journal.job(job)) for job in (first, second, aside)] == [Life.INTERRUPTED] * 3
        for job, words in ((first, f"job {second} has changed the table"), (aside, "ended with its process")):
            with pytest.raises(ConfigError, match=words):
                resume_job(cell, policy, journal, job)
        with pytest.raises(ConfigError, match="resume it with that"):
            resume_job(cell, make_policy("random", config), journal, second)
        refused = journal.start_job(("red",), policy.name, {}, config.journal.runs / "e", LockFile(NAME))
        journal.end_job(refused, "refused", "", 0.0)
        newest = journal.newest_job(NAME)
        assert newest is not None
        assert newest.id == second, "a job that was refused moved nothing"
        journal.end_job(second, "complete", "", 1.0)
        assert life(journal.job(second)) is None
        with pytest.raises(ConfigError, match="has ended"):
            resume_job(cell, policy, journal, second)
        running = journal.start_job(("red",), policy.name, {}, config.journal.runs / "d", cell.lock)
        assert life(journal.job(running)) is Life.RUNNING


PLACES = st.tuples(st.floats(-0.7, -0.3), st.floats(-0.2, 0.2))
GRASPS = PLACES.map(lambda place: Grasp(*place, 0.05, 3, 0.5))
PUSHES = PLACES.map(lambda place: Push(place, (-0.5, 0.0), 3, 0.05, 0.5))
TASKS = st.sampled_from([PickAny(), Uncover(np.zeros((1, 1), np.bool_))])
STEPS = st.lists(st.tuples(TASKS, GRASPS | PUSHES, st.sampled_from(list(Result))), max_size=12)


@settings(max_examples=40)
@given(steps=STEPS)
def test_the_journal_tells_where_a_job_stood(steps: list[tuple[Any, Grasp | Push, Result]]) -> None:
    """The same state follows from the rows as from the run itself."""
    workspace = Workspace()
    live, rows = Progress(), []
    for number, (task, action, result) in enumerate(steps):
        outcome = Outcome(result, None, "", float("nan"), 3.0)
        live = live.after("red", task, action, outcome, workspace)
        row: ActionRow = action_row(1, number, "red", task, action, 0.0)
        row.outcome = outcome_row(number, outcome, 1.0)
        assert isinstance(row.outcome, OutcomeRow)
        assert action_of(row) == action
        rows.append(row)
    stood = replay(rows, lambda _: None, workspace)
    assert (stood.goals, stood.failures, stood.pushes, stood.barred) == (
        live.goals,
        live.failures,
        live.pushes,
        live.barred,
    )


def test_a_journal_that_fails_in_a_job_stops_it_and_the_reason_is_its_own(
    config: CellConfig, opened: tuple[Cell, World]
) -> None:
    cell, _ = opened

    class Removing:
        """A policy during whose decision the folder of the runs is removed."""

        name, workspace = "heuristic", make_policy("heuristic", config).workspace

        def decide(self, observation: Any) -> Any:
            for path in config.journal.runs.glob("journal.db*"):
                path.unlink()
            return make_policy("heuristic", config).decide(observation)

    q = cell.arm.state().q
    with Journal(config.journal.database_url()) as journal, pytest.raises(StorageError, match="was removed"):
        run_job(cell, Removing(), journal, None)
    np.testing.assert_allclose(cell.arm.state().q, q, atol=1e-3)
    assert cell.latch.stop is None, "nothing moved"
