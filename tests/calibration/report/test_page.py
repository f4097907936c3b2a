import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from calibration.collect.session import read_session
from calibration.report.page import rebuild_report, write_report
from calibration.report.plots import magnification
from calibration.report.reprojection import reprojection_residuals
from calibration.solve.pipeline import solve
from robotcell.errors import StorageError
from tests.calibration.recorded import write_session
from tests.calibration.synthetic import BOARD, make_views

_VOID = {"meta", "br", "img", "image"}


class Page(HTMLParser):
    """Checks that every tag that is opened is closed, and keeps the words and the links."""

    def __init__(self, text):
        super().__init__()
        self.open, self.words, self.links = [], [], []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.links += [value for name, value in attributes if name in ("src", "href")]
        if tag not in _VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.links += [value for name, value in attributes if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.words.append(data)


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Fourteen views with images, one of them with a board that was knocked."""
    folder = tmp_path_factory.mktemp("session")
    views, _ = make_views(1, 14, corner_px=0.1, board=BOARD)
    T_base_flange = views.T_base_flange.copy()
    T_base_flange[5, 0, 3] += 0.03
    names = tuple(f"{i:03d} <&>" for i in range(14))
    write_session(folder, replace(views, names=names, T_base_flange=T_base_flange))
    return folder


@pytest.fixture(scope="module")
def solution(session):
    return solve(read_session(session))


def test_the_report_holds_everything_and_needs_nothing(session, solution, tmp_path):
    assert solution.accepted
    rebuilt = rebuild_report(session, tmp_path / "report.html")
    assert rebuilt.as_json() == solution.as_json()
    text = (tmp_path / "report.html").read_text()
    page = Page(text)
    words = " ".join(page.words)
    assert page.open == []
    assert all(link.startswith("data:image/jpeg;base64,") for link in page.links)
    assert len(page.links) == 14
    assert "Accepted" in words
    assert solution.verdict.words in words
    assert f"{1000 * solution.estimate.X[0, 3]:.2f}" in words
    assert "005 <&>" in words
    assert "left out: does not agree" in words
    drawings = re.findall(r"<svg.*?</svg>", text, re.DOTALL)
    # Two sides of the scene, errors, tilts, distances, coverage, and every view.
    assert len(drawings) == 6 + 14
    for drawing in drawings:
        ET.fromstring(drawing)


def test_a_refusal_is_reported_with_its_cure_and_without_a_transform(session, tmp_path):
    views = read_session(session)
    solution = solve(views.subset(range(6)))
    write_report(solution, tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text())
    words = " ".join(page.words)
    assert page.open == []
    assert "Refused" in words
    assert solution.verdict.cure in words
    assert "Where the camera stands" not in words


def test_poses_alone_are_reported_too(tmp_path):
    views, truth = make_views(2, 16, position_m=1e-4)
    T = np.linalg.inv(truth.X) @ views.T_base_flange @ truth.Z
    poses = replace(views, T_camera_board=T, corners=None, board=None, camera=None)
    solution = solve(poses)
    assert solution.accepted
    write_report(solution, tmp_path / "report.html")
    page = Page((tmp_path / "report.html").read_text())
    assert page.open == []
    assert page.links == []


def test_residuals_are_what_the_noise_was(solution):
    left = reprojection_residuals(solution)
    off = np.concatenate([left[name].off_px for name in left if not name.startswith("005")])
    assert 0.05 < np.sqrt((off**2).mean()) < 0.15
    assert 100 <= magnification(left.values()) <= 200
    assert np.linalg.norm(left["005 <&>"].off_px, axis=1).min() > 5


def test_a_folder_that_cannot_be_written_is_named(solution, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file"):
        write_report(solution, tmp_path / "file" / "report.html")
