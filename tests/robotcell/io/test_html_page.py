import jinja2
import pytest

from robotcell.errors import StorageError
from robotcell.io.html_page import write_html_page


@pytest.fixture
def template(tmp_path):
    path = tmp_path / "one.html.j2"
    path.write_text(
        '{% extends "base.html.j2" %}{% block title %}Words{% endblock %}{% block style %}.own { color: red; }'
        "{% endblock %}{% block body %}<p>{{ words }}</p>{% endblock %}"
    )
    return path


def test_a_page_stands_on_the_base_and_escapes_what_it_is_given(tmp_path, template):
    write_html_page(tmp_path / "new" / "page.html", template, {"words": "<b> & more"})
    html = (tmp_path / "new" / "page.html").read_text()
    assert html.startswith("<!DOCTYPE html>")
    assert "<title>Words</title>" in html
    assert "<p>&lt;b&gt; &amp; more</p>" in html
    # What a page adds stands after the base's style, and before what is for paper.
    assert html.index("body {") < html.index(".own") < html.index("@media print")
    assert "prefers-color-scheme: dark" in html


def test_what_the_template_needs_must_be_given(tmp_path, template):
    with pytest.raises(jinja2.UndefinedError, match="words"):
        write_html_page(tmp_path / "page.html", template, {})
    assert not (tmp_path / "page.html").exists()


def test_a_page_that_cannot_be_written_is_a_storage_error(tmp_path, template):
    (tmp_path / "page.html").mkdir()
    with pytest.raises(StorageError, match="cannot be written"):
        write_html_page(tmp_path / "page.html", template, {"words": ""})
