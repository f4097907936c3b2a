"""HTML pages on one base, `base.html.j2`: one file each with everything in it, for light and dark screens and paper."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2

from robotcell.io.atomic_file import make_folder, write_whole

if TYPE_CHECKING:
    from collections.abc import Mapping


def write_html_page(path: Path, template: Path, content: Mapping[str, Any]) -> None:
    """Fill in a template and write the page, as a whole or not at all; its folder is made.

    Args:
        path: of the page.
        template: a Jinja template that extends `base.html.j2`, with the blocks `title`, `style` and `body`. What it
            shows is escaped unless it says otherwise.
        content: by the template's names; one that is missing is an error.

    Raises:
        StorageError: the page cannot be written.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([template.parent, Path(__file__).parent]),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    html = environment.get_template(template.name).render(content)
    make_folder(path.parent)
    write_whole(path, html)
