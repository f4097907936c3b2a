from __future__ import annotations

import pytest

from policy.evaluation.suites import SUITES, find_suite, scene_goal
from robotcell.errors import ConfigError

CUBE = "v 0 0 0\nv .05 0 0\nv 0 .05 0\nv 0 0 .05\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def toml(*objects: tuple[str, str]) -> str:
    """A scene file of cubes in a row, by name and colour."""
    blocks = [
        f'[[object]]\nname = "{name}"\nshape = "cube"\ncolor = {color}\nposition = [{0.06 * i}, 0.0, 0.025]\n'
        for i, (name, color) in enumerate(objects)
    ]
    return "\n".join(['name = "made"', *blocks])


def rows(*names: str) -> str:
    return "".join(f"{name} cube.obj {-0.5 + 0.06 * i} 0 0.025 0 0 0\n" for i, name in enumerate(names))


def test_each_suite_makes_thirty_runs_and_asks_as_the_paper_does():
    for suite in SUITES.values():
        assert len(suite.cases) * suite.trials == 30
        assert {case.goal for case in suite.cases} == ({"red"} if suite.goal_oriented else {None})
    assert SUITES["random"].cases[0].objects == 30
    assert [case.scene for case in SUITES["challenging"].cases] == [case.scene for case in SUITES["agnostic"].cases]
    assert len(SUITES["challenging"].cases) == 10


def test_an_unknown_suite_is_refused_with_the_list():
    with pytest.raises(ConfigError, match="'easy'; there are random, challenging, agnostic, random-all, novel"):
        find_suite("easy")


@pytest.mark.parametrize(
    ("suffix", "text", "goal"),
    [
        (".toml", toml(("goal", '"blue"'), ("other", '"red"'), ("third", '"green"')), "red"),
        (".toml", toml(("goal", '"blue"'), ("pink one", '"red"'), ("third", '"red"')), "blue"),
        (".toml", toml(("goal", '"blue"'), ("other", '"green"')), "blue"),
        (".txt", rows("block", "green", "block"), "green"),
        (".txt", rows("block", "green", "red"), "red"),
        (".txt", "cube.obj 1 .3412 .349 -0.5 0 0.025 0 0 0\ncube.obj 0 0 1 -0.4 0 0.025 0 0 0\n", "red"),
    ],
)
def test_the_goal_is_the_red_object_or_what_the_file_calls_it(tmp_path, suffix, text, goal):
    (tmp_path / "cube.obj").write_text(CUBE)
    path = tmp_path / f"scene{suffix}"
    path.write_text(text)
    assert scene_goal(path, tmp_path) == goal


@pytest.mark.parametrize(
    ("suffix", "text"),
    [
        (".toml", toml(("green cube", '"green"'), ("blue cube", '"blue"'))),
        (".toml", toml(("goal", "[1, 2, 3]"))),
        (".txt", rows("block", "block")),
    ],
)
def test_a_scene_without_a_clear_goal_is_refused(tmp_path, suffix, text):
    (tmp_path / "cube.obj").write_text(CUBE)
    path = tmp_path / f"scene{suffix}"
    path.write_text(text)
    with pytest.raises(ConfigError, match="not clear which object is the goal"):
        scene_goal(path, tmp_path)


def test_scene_files_stand_in_for_the_scenes_of_a_suite(tmp_path):
    (tmp_path / "cube.obj").write_text(CUBE)
    (tmp_path / "frames.toml").write_text('["cube.obj"]\nx = [1, 0, 0]\ny = [0, 1, 0]\n')
    (tmp_path / "b.txt").write_text(rows("block", "green"))
    (tmp_path / "a.toml").write_text(toml(("goal", '"red"'), ("other", '"blue"')))
    suite = find_suite("challenging", tmp_path, tmp_path)
    assert [(case.label, case.goal) for case in suite.cases] == [("a.toml", "red"), ("b.txt", "green")]
    assert {case.goal for case in find_suite("agnostic", tmp_path, tmp_path).cases} == {None}


def test_folders_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="no such folder; --scenes"):
        find_suite("random", tmp_path / "none")
    with pytest.raises(ConfigError, match="no scene files in it"):
        find_suite("random", tmp_path)
    with pytest.raises(ConfigError, match="belongs to scene files"):
        find_suite("random", None, tmp_path)
    (tmp_path / "notes.txt").write_text("what is here\n")
    for name in ("random", "agnostic"):
        with pytest.raises(ConfigError, match=r"notes.txt, line 1"):
            find_suite(name, tmp_path)
