"""The suites of the benchmark: which scenes, and what is to be picked from them (docs/explanation/benchmark.md)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from robotcell.errors import ConfigError
from robotcell.perception.colors import PALETTE
from sim_twin.scenes.catalog import GOAL, scene_names
from sim_twin.scenes.files import FRAMES_FILE, read_scene

if TYPE_CHECKING:
    from pathlib import Path

_SCENE_SUFFIXES = {".toml", ".txt"}
_COLOR_NAMES = {rgb: name for name, rgb in PALETTE.items()}


@dataclass(frozen=True)
class Case:
    """One scene of a suite.

    Attributes:
        label: what results call it; unique in its suite.
        scene: `backend.options.scene`, a name or a path.
        goal: colour of what is to be picked; None stands for everything.
        objects: how many, where the seed draws them; None where the scene has its own.
        meshes: folder of the OBJ files that a scene file names.
    """

    label: str
    scene: str
    goal: str | None
    objects: int | None = None
    meshes: str | None = None


@dataclass(frozen=True)
class Suite:
    """A set of scenes with one request.

    Attributes:
        title: what it asks, in a few words.
        cases: its scenes.
        trials: how many per scene unless asked otherwise; 30 in all, as in the paper.
        goal_oriented: whether one goal is to be picked, otherwise everything.
    """

    title: str
    cases: tuple[Case, ...]
    trials: int
    goal_oriented: bool


_CHALLENGING = tuple(name for name in scene_names() if name.startswith("challenging"))

# Paper, section "Evaluation"; the last two are this cell's own.
SUITES = {
    "random": Suite("one goal among 29 obstacles", (Case("random-goal", "random-goal", GOAL, 30),), 30, True),
    "challenging": Suite(
        "a goal that no grasp reaches before a push", tuple(Case(name, name, GOAL) for name in _CHALLENGING), 3, True
    ),
    "agnostic": Suite(
        "everything in the challenging scenes", tuple(Case(name, name, None) for name in _CHALLENGING), 3, False
    ),
    "random-all": Suite("everything, ten random blocks", (Case("random", "random", None, 10),), 30, False),
    "novel": Suite("everything, ten objects that are no blocks", (Case("novel", "novel", None, 10),), 30, False),
}


def find_suite(name: str, scenes: Path | None = None, meshes: Path | None = None) -> Suite:
    """The suite of that name.

    Args:
        name: one of `SUITES`.
        scenes: folder of scene files that stand in for the suite's own scenes; goal-oriented suites ask for the goal
            that each file has (`scene_goal`).
        meshes: folder of the OBJ files that they name.

    Raises:
        ConfigError: there is no such suite, folder or scene file, or a file is malformed or has no goal.
    """
    if name not in SUITES:
        raise ConfigError(f"no suite is called {name!r}; there are {', '.join(SUITES)}")
    suite = SUITES[name]
    if scenes is None:
        if meshes is not None:
            raise ConfigError(f"--meshes {meshes} belongs to scene files: name their folder with --scenes")
        return suite
    cases = tuple(_file_case(path, suite, meshes) for path in _scene_files(scenes))
    return Suite(suite.title, cases, SUITES["challenging"].trials, suite.goal_oriented)


def describe_suite(name: str, scenes: str | None) -> str:
    """What a suite asks, in a few words; `scenes` is the folder of scene files that stand in for its own."""
    suite = SUITES[name]
    if scenes is None:
        return suite.title
    return f"{'the goal' if suite.goal_oriented else 'everything'} in the scenes of {scenes}"


def scene_goal(path: Path, meshes: Path | None) -> str:
    """The colour of a scene file's goal: red where exactly one object is, otherwise what the file calls its goal.

    A TOML file calls an object its goal by the name `goal`; the text format of eight fields calls its goals by their
    colours and everything else `block`. The first one counts.

    Raises:
        ConfigError: the file is malformed, or names no goal whose colour has a name.
    """
    objects = read_scene(path, meshes).objects
    if sum(item.color == PALETTE[GOAL] for item in objects) == 1:
        return GOAL
    goal_names = {"goal"} if path.suffix.lower() == ".toml" else set(PALETTE)
    for item in objects:
        if item.name.partition(" ")[0] in goal_names and item.color in _COLOR_NAMES:
            return _COLOR_NAMES[item.color]
    raise ConfigError(
        f"{path}: it is not clear which object is the goal: give exactly one the colour {GOAL}, or in a TOML file the "
        "name 'goal' and a colour that has a name"
    )


def _scene_files(folder: Path) -> list[Path]:
    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; --scenes names one with scene files")
    files = sorted(
        path
        for path in folder.resolve().iterdir()
        if path.suffix.lower() in _SCENE_SUFFIXES and path.name != FRAMES_FILE and path.is_file()
    )
    if not files:
        raise ConfigError(f"{folder}: no scene files in it; they end in .toml or .txt (docs/reference/scene-files.md)")
    return files


def _file_case(path: Path, suite: Suite, meshes: Path | None) -> Case:
    goal = None
    if suite.goal_oriented:
        goal = scene_goal(path, meshes)
    else:
        read_scene(path, meshes)
    return Case(path.name, str(path), goal, meshes=str(meshes.resolve()) if meshes else None)
