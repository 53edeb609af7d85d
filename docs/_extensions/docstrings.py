"""Adapt docstrings and signatures to reStructuredText.

Docstrings write ``|x|`` for absolute values, which reStructuredText reads as a substitution; signatures of
dataclasses contain ``<factory>``, which is no Python expression and would be printed without links.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from typing import Any

_CODE_OR_BAR = re.compile(r"(``.*?``|`.*?`)|\|")


def escape_bars(lines: Iterable[str]) -> Iterator[str]:
    """Yield the lines with their bars escaped, except in inline code and in literal blocks."""
    literal_indent: int | None = None  # indentation of the line that introduced a literal block
    for line in lines:
        indent = len(line) - len(line.lstrip())
        if literal_indent is not None and line.strip() and indent <= literal_indent:
            literal_indent = None
        if literal_indent is not None:
            yield line
            continue
        if line.endswith("::"):
            literal_indent = indent
        yield _CODE_OR_BAR.sub(lambda match: match.group(1) or r"\|", line)


def _on_docstring(app: Any, what: str, name: str, obj: Any, options: Any, lines: list[str]) -> None:
    lines[:] = list(escape_bars(lines))


def parsable(signature: str | None) -> str | None:
    """Return the signature with an ellipsis for each default that a factory makes."""
    return signature and signature.replace("<factory>", "...")


def _on_signature(
    app: Any, what: str, name: str, obj: Any, options: Any, signature: str | None, result: str | None
) -> tuple[str | None, str | None]:
    return parsable(signature), result


def setup(app: Any) -> dict[str, bool]:
    app.connect("autodoc-process-docstring", _on_docstring)
    app.connect("autodoc-process-signature", _on_signature)
    return {"parallel_read_safe": True}
