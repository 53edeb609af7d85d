"""The directive ``command-options CLASS``: the options that a dataclass of `app.options` adds, as a table.

The table is read from the dataclass that the parser is built from, so the two cannot disagree.
"""

from __future__ import annotations

import ast
import dataclasses
import inspect
from itertools import pairwise
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

from docutils import nodes
from docutils.parsers.rst import Directive
from tyro.conf import Positional

from app import options as app_options

POSITIONAL = get_args(Positional[int])[1]
PLACEHOLDERS = {int: "INT", float: "FLOAT", str: "STR", Path: "PATH"}


class Option(NamedTuple):
    """One row of the table."""

    flag: str  # as typed: `--seed INT`, or the placeholder of a positional argument
    default: str
    description: str


class CommandOptions(Directive):
    """Insert the table of one class; its base classes have tables of their own."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        rows = own_options(getattr(app_options, self.arguments[0]))
        group = nodes.tgroup(cols=3)
        group += [nodes.colspec(colwidth=width) for width in (34, 16, 50)]
        group += nodes.thead("", _row(*(nodes.Text(title) for title in ("Option", "Default", "Meaning"))))
        group += nodes.tbody(
            "", *(_row(_code(o.flag), _code(o.default), nodes.Text(o.description)) for o in rows)
        )
        return [nodes.table("", group)]


def own_options(kind: type) -> list[Option]:
    """Return the options that a class adds to its bases, in the order of their definition."""
    hints = get_type_hints(kind, include_extras=True)
    descriptions = _descriptions(kind)
    own = [field for field in dataclasses.fields(kind) if field.name in vars(kind).get("__annotations__", {})]
    return [_option(field, hints[field.name], descriptions[field.name]) for field in own]


def _option(field: dataclasses.Field[Any], hint: Any, description: str) -> Option:
    metadata = hint.__metadata__ if get_origin(hint) is Annotated else ()
    setting = next((m for m in metadata if hasattr(m, "help_behavior_hint")), None)
    placeholder = getattr(setting, "metavar", None) or _placeholder(hint)
    hinted = getattr(setting, "help_behavior_hint", None)
    if POSITIONAL in metadata:
        required = field.default is dataclasses.MISSING
        name = placeholder if setting or "{" in str(placeholder) else field.name.upper()
        return Option(str(name), "required" if required else "", description)
    flag = f"--{field.name.replace('_', '-')}"
    default = hinted.removeprefix("default: ") if isinstance(hinted, str) else _default(field.default)
    return Option(flag if placeholder is None else f"{flag} {placeholder}", default, description)


def _placeholder(hint: Any) -> str | None:
    """Return what stands for a value of this type; None for switches."""
    if get_origin(hint) is Annotated:
        return _placeholder(get_args(hint)[0])
    if hint is bool:
        return None
    if get_origin(hint) is Literal:
        return "{" + ",".join(get_args(hint)) + "}"
    if get_origin(hint) is tuple:
        return f"{_placeholder(get_args(hint)[0])} ..."
    if get_origin(hint) in (Union, UnionType):
        return _placeholder(get_args(hint)[0])
    return PLACEHOLDERS[hint]


def _default(value: Any) -> str:
    if isinstance(value, bool):
        return ""
    return " ".join(map(str, value)) if isinstance(value, tuple) else str(value)


def _descriptions(kind: type) -> dict[str, str]:
    """Return the string after each field of the class, as written in its source."""
    body = ast.parse(inspect.getsource(kind)).body[0].body  # pyright: ignore[reportAttributeAccessIssue]
    return {
        field.target.id: " ".join(text.value.value.split())
        for field, text in pairwise(body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(field.target, ast.Name)
        and isinstance(text, ast.Expr)
        and isinstance(text.value, ast.Constant)
    }


def _code(text: str) -> nodes.Node:
    return nodes.literal("", text) if text else nodes.Text("")


def _row(*cells: nodes.Node) -> nodes.row:
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", cell)) for cell in cells))


def setup(app: Any) -> dict[str, bool]:
    app.add_directive("command-options", CommandOptions)
    return {"parallel_read_safe": True}
