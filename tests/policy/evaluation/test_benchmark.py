from __future__ import annotations

import json

import pytest

from policy.evaluation.benchmark import finished, load, plan, run, start, write_json
from robotcell.config import load_config
from robotcell.errors import ConfigError, StorageError
from tests.policy.evaluation.examples import ORIGIN, settings
from tests.policy.evaluation.test_suites import toml


def in_folder(tmp_path, **values):
    return settings(cell=load_config(None, {"journal.runs": tmp_path / "runs"}), **values)


@pytest.fixture
def tiny(tmp_path):
    """Settings of two trials of a second each."""
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "one.toml").write_text(toml(("goal", '"red"')))
    return in_folder(tmp_path, suites=("challenging",), trials=2, scenes=str(tmp_path / "scenes"))


def test_policies_meet_the_same_seeds_side_by_side():
    trials = plan(settings(suites=("challenging", "novel"), policies=("heuristic", "random"), trials=2, seed=7))
    assert len(trials) == (10 + 1) * 2 * 2
    assert [(t.case.label, t.seed, t.policy) for t in trials[:5]] == [
        ("challenging-01", 7, "heuristic"),
        ("challenging-01", 7, "random"),
        ("challenging-01", 8, "heuristic"),
        ("challenging-01", 8, "random"),
        ("challenging-02", 7, "heuristic"),
    ]
    assert len({trial.key for trial in trials}) == len(trials)
    assert len(plan(settings(trials=None))) == 30


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"trials": 0}, "0 trials per scene"),
        ({"seed": -1}, "seeds start at 0"),
        ({"suites": ("easy",)}, "no suite is called 'easy'"),
        ({"policies": ("oracle",)}, "no policy is called 'oracle'"),
        ({"meshes": "meshes"}, "belongs to scene files"),
    ],
)
def test_settings_that_make_no_benchmark_are_refused(values, message):
    with pytest.raises(ConfigError, match=message):
        plan(settings(**values))


def test_a_benchmark_goes_on_where_it_was_cut_off(tiny):
    trials = plan(tiny)
    folder = start(tiny)
    assert load(folder)[0] == tiny
    running = run(folder, trials, None, None)
    first = next(running)
    running.close()
    lines = folder / "trials.jsonl"
    lines.write_text(lines.read_text() + '{"suite": "chal')
    assert finished(folder, trials) == [first]
    (second,) = run(folder, trials, None, None)
    assert (first.seed, second.seed) == (0, 1)
    assert finished(folder, trials) == [first, second]
    assert list(run(folder, trials, None, None)) == []
    assert len(lines.read_text().splitlines()) == 2


def test_a_folder_that_is_no_benchmark_is_refused(tmp_path, tiny):
    with pytest.raises(ConfigError, match="--resume names the folder"):
        load(tmp_path)
    path = tmp_path / "benchmark.json"
    for text in ("", "[]", "{}", '{"version": 1, "settings": {}}', '{"version": 1, "settings": {"cell": {"a": 1}}}'):
        path.write_text(text)
        with pytest.raises(ConfigError, match=r"not (of a benchmark|a JSON file)"):
            load(tmp_path)
    path.write_text('{"version": 99}')
    with pytest.raises(ConfigError, match="version 99"):
        load(tmp_path)
    for line in ("3", "{", '{"suite": "random"}'):
        (tmp_path / "trials.jsonl").write_text(line + "\n")
        with pytest.raises(ConfigError, match="line 1: not the result of a trial"):
            finished(tmp_path, plan(tiny))


def test_a_password_of_the_journal_is_not_written_down(tmp_path):
    cell = load_config(None, {"journal.runs": tmp_path / "runs", "journal.url": "sqlite:///secret.db"})
    folder = start(settings(cell=cell))
    assert "secret" not in (folder / "benchmark.json").read_text()


def test_json_that_cannot_be_written_is_refused(tmp_path):
    path = tmp_path / "out.json"
    write_json(path, settings(), ORIGIN, [])
    assert json.loads(path.read_text())["version"] == 1
    with pytest.raises(StorageError, match="cannot be written"):
        write_json(tmp_path / "none" / "out.json", settings(), ORIGIN, [])
