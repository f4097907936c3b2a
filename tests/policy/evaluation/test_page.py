from __future__ import annotations

import re
from html.parser import HTMLParser

import pytest

from policy.evaluation.benchmark import by_suite
from policy.evaluation.metrics import measure
from policy.evaluation.page import write_page
from policy.evaluation.report import results_table
from policy.evaluation.trials import Failure
from robotcell.errors import ConfigError, StorageError
from tests.policy.evaluation.examples import ORIGIN, result, run, settings


class Tags(HTMLParser):
    """Counts tags and checks that those that need an end have one."""

    def __init__(self, text):
        super().__init__()
        self.counts, self.open = {}, []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attrs):
        self.counts[tag] = self.counts.get(tag, 0) + 1
        if tag not in {"meta", "img"}:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "x.jpg").write_bytes(b"not really a picture")
    return tmp_path


MISSED = Failure("1. grasp for red", "missed", "the fingers were <1 mm apart", "x.jpg")


def test_the_page_stands_alone_and_shows_every_part(folder):
    results = [
        run(2, policy="heuristic", failures={"missed": 1}, shown=(MISSED,)),
        run(1, policy="random"),
        result(policy="random", seed=1, reason="no red object is seen", failures={"missed": 3}, shown=(MISSED,)),
        *(result(suite="agnostic", scene=f"challenging-0{i}", goal=None) for i in (1, 2)),
    ]
    path = write_page(folder, settings(suites=("random", "agnostic")), ORIGIN, results)
    text = path.read_text()
    tags = Tags(text)
    assert tags.open == []
    # Two suites: results and failures of each where there are failures, scenes of the second.
    assert tags.counts["table"] == 4
    assert tags.counts["img"] == 2
    assert re.findall(r'src="(?!data:)|href=|<script|url\(', text) == []
    assert "&lt;1 mm apart" in text
    assert "The run ended: no red object is seen" in text
    assert "robotcell bench --suite random,agnostic --policy heuristic --trials 1 --seed 0" in text
    assert "100.0 %" in text
    assert "EPG, published" in text
    assert "prefers-color-scheme: dark" in text
    assert "@media print" in text


def test_a_long_gallery_is_cut_with_incomplete_runs_kept(folder):
    results = [run(2, seed=seed, shown=(MISSED,)) for seed in range(20)]
    results.append(result(seed=99, shown=(MISSED,)))
    text = write_page(folder, settings(), ORIGIN, results).read_text()
    assert Tags(text).counts["img"] == 12
    assert "seed 99" in text
    assert "9 more in the folder" in text


def test_a_page_that_cannot_be_made_says_why(folder):
    gone = Failure("1. grasp", "missed", "", "gone.jpg")
    with pytest.raises(ConfigError, match=r"gone.jpg: No such file"):
        write_page(folder, settings(), ORIGIN, [result(shown=(gone,))])
    (folder / "index.html").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        write_page(folder, settings(), ORIGIN, [result()])


def test_the_table_has_the_policies_and_what_was_published():
    figures = by_suite([run(1), run(2, 1, seed=1), result(seed=2), run(1, policy="random")])["random"]
    table = results_table("random", True, figures)
    assert table.header[:4] == ("policy", "completion", "goal grasp success", "motions")
    heuristic = table.rows[0]
    assert heuristic.label == "heuristic"
    assert [cell.text for cell in heuristic.cells[:3]] == ["66.7 %", "75.0 %", "2.00"]
    assert heuristic.cells[0].note == "2 of 3; 21 to 94"
    assert [row.published for row in table.rows] == [False] * 2 + [True] * 5
    assert len({len(row.cells) for row in table.rows} | {len(table.header) - 1}) == 1


def test_a_suite_for_everything_shows_its_efficiency():
    runs = [result(goal=None, completed=True, objects=5, actions=8, grasp_attempts=5, grasp_successes=5)]
    table = results_table("agnostic", False, {"heuristic": measure(runs)})
    assert table.header[3] == "action efficiency"
    assert table.rows[0].cells[2].text == "62.5 %"
    assert table.rows[-1].cells[2].text == "61.1 %"
