"""The pages that code, examples and READMEs name are there. `make docs` checks the links inside the site."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("robotcell", "calibration", "policy", "sim_twin", "cli", "examples")
SUFFIXES = {".py", ".toml", ".md", ".j2"}
# A history names the pages of its time.
SOURCES = [
    path
    for path in (*ROOT.glob("*.*"), *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.*")))
    if path.suffix in SUFFIXES and path.name != "CHANGELOG.md"
]
NAMED = re.compile(r"\bdocs/[\w./-]+\.(?:md|html|gif|png)")
LINK = re.compile(r"\]\(([^)#:]+)(?:#[^)]*)?\)")


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_pages_that_are_named_exist(source: Path) -> None:
    text = source.read_text(encoding="utf-8")
    # A link of a file that lies deeper says ../../docs/..., which holds the same name.
    missing = [name for name in NAMED.findall(text) if not (ROOT / name).is_file()]
    if source.suffix == ".md":
        missing += [link for link in LINK.findall(text) if not (source.parent / link).exists()]
    assert not missing
