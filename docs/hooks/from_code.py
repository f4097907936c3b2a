"""Fills pages with what the code says: settings, commands, errors and tables of the journal.

A page holds a comment such as `<!-- from code: settings robotcell.config.schema:CellConfig -->`, which MkDocs replaces
when it builds the site. A setting or an option without a description ends the build.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import json
import os
import re
import textwrap
import types
from importlib import import_module
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, Union, get_args, get_origin

import typer
from pydantic import BaseModel
from typer.main import get_command

if TYPE_CHECKING:
    from collections.abc import Iterator

    import click
    from mkdocs.structure.pages import Page
    from pydantic.fields import FieldInfo

_MARK = re.compile(r"^<!-- from code: (\w+) ?(.*?) -->$", re.MULTILINE)
_ROOT = Path(__file__).parents[2]


def on_page_markdown(markdown: str, page: Page, **_: Any) -> str:
    """MkDocs calls this for each page."""
    makers = {"settings": _settings, "commands": _commands, "errors": _errors, "journal": _journal, "card": _card}

    def fill(match: re.Match[str]) -> str:
        return makers[match[1]](match[2], page.file.src_uri)

    return _MARK.sub(fill, markdown)


def _settings(words: str, _page: str) -> str:
    """Tables of a pydantic model, `MODULE:CLASS PREFIX LEVEL` (prefix `-`: none), one for each table of the file."""
    name, prefix, level = words.split()
    module, cls = name.split(":")
    model = getattr(import_module(module), cls)
    return "\n".join(_model(model, None, "" if prefix == "-" else prefix, int(level)))


def _model(model: type[BaseModel], given: object, prefix: str, level: int) -> Iterator[str]:
    """The tables of a model; `given` holds the defaults where they are not those of its class."""
    told = _descriptions(model)
    plain, tables = [], []
    for key, field in model.model_fields.items():
        inner = _inner_model(field.annotation)
        (tables if inner else plain).append((key, field, inner))
    if plain:
        yield from ("| key | default | allowed | |", "|---|---|---|---|")
        for key, field, _ in plain:
            if key not in told:
                raise ValueError(f"{model.__name__}.{key} has no description: write a comment above it")
            default = _default(field) if given is None else f"`{_toml(getattr(given, key))}`"
            yield f"| `{prefix}{key}` | {default} | {_allowed(field)} | {told[key]} |"
        yield ""
    for key, field, inner in tables:
        assert inner is not None
        many = get_origin(field.annotation) is tuple
        title = f"[[{prefix}{key}]]" if many else f"[{prefix}{key}]"
        yield from (f"{'#' * level} `{title}`", "", told.get(key) or _first_paragraph(inner), "")
        different = field.default if isinstance(field.default, BaseModel) and field.default.model_fields_set else None
        yield from _model(inner, different, f"{prefix}{key}.", level)


def _descriptions(model: type[BaseModel]) -> dict[str, str]:
    """What is said of each field: by the comment above it, or under `Attributes:` of the docstring."""
    said: dict[str, str] = {}
    for cls in reversed([cls for cls in model.__mro__ if issubclass(cls, BaseModel) and cls is not BaseModel]):
        source = textwrap.dedent(inspect.getsource(cls))
        lines = source.splitlines()
        body = ast.parse(source).body[0]
        assert isinstance(body, ast.ClassDef)
        for node in body.body:
            if isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                above: list[str] = []
                at = node.lineno - 2
                while lines[at].strip().startswith("#"):
                    above.insert(0, lines[at].strip().lstrip("# "))
                    at -= 1
                if above:
                    said[node.target.id] = " ".join(above)
    said |= _attributes(inspect.getdoc(model) or "")
    return {key: _cell(_capitalised(text)) for key, text in said.items()}


def _capitalised(text: str) -> str:
    """A sentence begins with a capital, but x stays x."""
    return text if re.match(r"\w\b", text) else text[0].upper() + text[1:]


def _attributes(doc: str) -> dict[str, str]:
    """The entries of a Google-style `Attributes:` section."""
    section = re.search(r"^Attributes:\n((?:[ ]+.*\n?|\n)+)", doc, re.MULTILINE)
    entries: dict[str, str] = {}
    if section is None:
        return entries
    name = ""
    for line in textwrap.dedent(section[1]).splitlines():
        start = re.match(r"(\w+): (.*)", line)
        if start:
            name, entries[start[1]] = start[1], start[2]
        elif line.strip():
            entries[name] += " " + line.strip()
    return entries


def _inner_model(annotation: Any) -> type[BaseModel] | None:
    """The model that a field holds, or holds several of."""
    inner = get_args(annotation)[0] if get_origin(annotation) is tuple else annotation
    return inner if isinstance(inner, type) and issubclass(inner, BaseModel) else None


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "needed"
    value = field.default
    if value is None:
        return "none"
    if isinstance(value, dict):
        return "none" if not value else f"`{json.dumps(value)}`"
    return f"`{_toml(value)}`"


def _toml(value: Any) -> str:
    """As a TOML file has it."""
    if isinstance(value, tuple | list):
        return f"[{', '.join(_toml(v) for v in value)}]"
    return json.dumps(str(value) if isinstance(value, Path) else value)


def _allowed(field: FieldInfo) -> str:
    """What a value must be, in words."""
    kind = _kind(field.annotation)
    limits = {name: getattr(rule, name) for rule in field.metadata for name in ("gt", "ge", "lt", "le", "pattern")
              if getattr(rule, name, None) is not None}  # fmt: skip
    if "ge" in limits and "le" in limits:
        return f"{kind}, {limits['ge']:g} to {limits['le']:g}"
    words = [f"{sign} {limits[name]:g}" for name, sign in (("gt", "above"), ("ge", "at least")) if name in limits]
    words += [f"{sign} {limits[name]:g}" for name, sign in (("lt", "below"), ("le", "at most")) if name in limits]
    return f"{kind}, {' and '.join(words)}" if words else kind


def _kind(annotation: Any) -> str:
    origin, args = get_origin(annotation), get_args(annotation)
    if origin in {Union, types.UnionType}:
        return _kind(next(arg for arg in args if arg is not type(None)))
    if hasattr(annotation, "__metadata__"):
        return _kind(args[0])
    if origin is tuple:
        if args[-1] is Ellipsis:
            return f"list of {_kind(args[0])}"
        return f"{len(args)} {_kind(args[0])}s"
    if origin is dict or annotation is dict:
        return "table"
    return {float: "number", int: "whole number", bool: "true or false", str: "text", Path: "path"}[annotation]


def _commands(_words: str, _page: str) -> str:
    """Every command of the program, with its arguments and options."""
    from cli.main import app

    return "\n".join(_command(get_command(app), "robotcell", None))


def _command(command: click.Command, path: str, parent: click.Context | None) -> Iterator[str]:
    context = typer.Context(command, info_name=path.rpartition(" ")[2], parent=parent)
    paragraphs = [" ".join(part.split()) for part in inspect.cleandoc(command.help or "").split("\n\n")]
    yield from (f"## `{path}`", "")
    for paragraph in paragraphs:
        yield from (_cell(paragraph), "")
    usage = " ".join(command.collect_usage_pieces(context))
    yield from ("```", f"{path} {usage}".rstrip(), "```", "")
    rows = [_parameter(parameter, context) for parameter in command.params if not getattr(parameter, "hidden", False)]
    if rows:
        yield from ("| | default | |", "|---|---|---|", *rows, "")
    for name, inner in getattr(command, "commands", {}).items():
        yield from _command(inner, f"{path} {name}", context)


def _parameter(parameter: click.Parameter, context: click.Context) -> str:
    record = parameter.get_help_record(context)
    told = getattr(parameter, "help", None) or ""
    if parameter.param_type_name == "argument":
        name = record[0] if record else parameter.metavar or parameter.human_readable_name
        return f"| `{name}` | | {_cell(told)} |"
    if not told or record is None:
        raise ValueError(f"{context.command_path} {parameter.opts[0]} has no help")
    default = parameter.default
    shown = "" if default is None or isinstance(default, bool) else f"`{default}`"
    return f"| `{record[0]}` | {shown} | {_cell(told)} |"


def _errors(_words: str, _page: str) -> str:
    """Every error: its code, the exit code of a command that ends with it, and what to do."""
    from cli.console import exit_code
    from robotcell import errors

    lines = ["| error | `code` | exit code | also a | |", "|---|---|---|---|---|"]
    for error in errors.CellError.__subclasses__():
        builtin = next(base for base in error.__bases__ if base is not errors.CellError)
        row = (f"`{error.__name__}`", f"`{error.code}`", exit_code(error("")), f"`{builtin.__name__}`")
        lines.append(f"| {' | '.join(str(part) for part in row)} | {_cell(_first_paragraph(error))} |")
    return "\n".join(lines)


def _journal(_words: str, _page: str) -> str:
    """The tables of the journal."""
    from robotcell.jobs import journal_tables

    lines = []
    for mapper in journal_tables.Base.__subclasses__():
        told = _columns(mapper)
        lines += [
            f"### `{mapper.__tablename__}`",
            "",
            _first_paragraph(mapper),
            "",
            "| column | type | |",
            "|---|---|---|",
        ]
        for column in mapper.__table__.columns:
            kind = f"{column.type}{'' if not column.nullable else ' or null'}".lower()
            link = "".join(f" (`{key.target_fullname}`)" for key in column.foreign_keys)
            lines.append(f"| `{column.name}` | {kind} | {told[column.name]}{link} |")
        lines.append("")
    return "\n".join(lines)


def _columns(mapper: type) -> dict[str, str]:
    lines = inspect.getsource(mapper).splitlines()
    told: dict[str, str] = {}
    for above, line in itertools.pairwise(lines):
        field = re.match(r"    (\w+): Mapped", line)
        if field and above.strip().startswith("#"):
            told[field[1]] = _cell(above.strip().lstrip("# "))
    return told


def _card(path: str, page: str) -> str:
    """A Markdown file from beside the code, without its title, its links made to fit."""
    file = _ROOT / path
    text = file.read_text(encoding="utf-8").split("\n", 1)[1]

    def relink(match: re.Match[str]) -> str:
        target = (file.parent / match[1]).resolve()
        inside = target.relative_to(_ROOT / "docs").as_posix()
        return f"]({os.path.relpath(inside, PurePosixPath(page).parent)}{match[2] or ''})"

    return re.sub(r"\]\(([^)#:]+)(#[^)]*)?\)", relink, text)


def _first_paragraph(thing: object) -> str:
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


def _cell(text: str) -> str:
    """Text that stands in a cell of a table."""
    return text.replace("|", "\\|").replace("<", "&lt;")
