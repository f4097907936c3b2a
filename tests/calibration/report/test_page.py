import re
from dataclasses import replace
from html.parser import HTMLParser
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from calibration.collect.session import SessionHeader, ViewRecord, add_view, create_session, read_session
from calibration.report.figures import magnification, residuals
from calibration.report.page import write_report
from calibration.solve.solver import solve
from robotcell.errors import ConfigError
from tests.calibration.synthetic import BOARD, CAMERA, DATE, make_views

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
    header = SessionHeader(mount="fixed", camera=CAMERA, board=BOARD, started=DATE, software="test")
    create_session(folder, header)
    for i, corners in enumerate(views.corners):
        T = views.T_base_flange[i].copy()
        if i == 5:
            T[0, 3] += 0.03
        record = ViewRecord(
            name=f"{i:03d} <&>",
            T_base_flange=T.tolist(),
            ids=corners.ids.tolist(),
            corners_px=corners.px.tolist(),
            taken=DATE,
            q=(0.0,) * 6,
            T_base_tcp=T.tolist(),
        )
        add_view(folder, record, np.full((720, 1280, 3), 90, np.uint8), None)
    return folder


def test_the_report_holds_everything_and_needs_nothing(session, tmp_path):
    solution = solve(read_session(session))
    assert solution.accepted
    write_report(solution, tmp_path / "report.html", session)
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


def test_residuals_are_what_the_noise_was(session):
    left = residuals(solve(read_session(session)))
    off = np.concatenate([left[name].off_px for name in left if not name.startswith("005")])
    assert 0.05 < np.sqrt((off**2).mean()) < 0.15
    assert 100 <= magnification(left.values()) <= 200
    assert np.linalg.norm(left["005 <&>"].off_px, axis=1).min() > 5


def test_a_folder_that_cannot_be_written_is_named(session, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot be written"):
        write_report(solve(read_session(session)), tmp_path / "file" / "report.html")
