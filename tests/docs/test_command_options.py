"""The generated option tables agree with the parser, and every command has its tables."""

import dataclasses
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from tyro.conf import Positional, arg

from app.cli import run
from app.options import COMMANDS

PAGE = (Path(__file__).parents[2] / "docs" / "commands.md").read_text("utf-8")


@dataclass(frozen=True, kw_only=True)
class Base:
    inherited: int = 1
    """Listed with the base class."""


@dataclass(frozen=True, kw_only=True)
class Example(Base):
    source: Positional[Path]
    """Folder."""
    kind: Positional[Literal["a", "b"]]
    """Kind."""
    free_text: Annotated[str | None, arg(metavar="TEXT", help_behavior_hint="default: none")] = None
    """A text
    on two lines."""
    choice: Literal["x", "y"] = "y"
    """Choice."""
    numbers: tuple[int, ...] = (1, 2)
    """Numbers."""
    factor: float = 0.5
    """Factor."""
    switch: bool = False
    """Switch."""


def test_own_options_are_written_as_they_are_typed(command_options):
    assert command_options.own_options(Example) == [
        ("SOURCE", "required", "Folder."),
        ("{a,b}", "required", "Kind."),
        ("--free-text TEXT", "none", "A text on two lines."),
        ("--choice {x,y}", "y", "Choice."),
        ("--numbers INT ...", "1 2", "Numbers."),
        ("--factor FLOAT", "0.5", "Factor."),
        ("--switch", "", "Switch."),
    ]


@pytest.mark.parametrize("command", COMMANDS)
def test_tables_list_the_options_of_the_parser(command_options, command, capsys):
    kinds = [kind for kind in COMMANDS[command].__mro__ if dataclasses.is_dataclass(kind)]
    listed = {o.flag.split()[0] for kind in kinds for o in command_options.own_options(kind)}
    assert run([command, "--help"]) == 0
    parsed = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", capsys.readouterr().out)) - {"--help"}
    mentioned = {"--seed", "--out"}  # descriptions name other options of the same command
    assert {flag for flag in listed if flag.startswith("--")} == parsed | (listed & mentioned)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_a_section_with_its_tables(command_options, command):
    headings = {name for line in re.findall(r"^### (.+)$", PAGE, re.M) for name in line.split(", ")}
    assert command in headings
    for kind in COMMANDS[command].__mro__:
        if dataclasses.is_dataclass(kind) and command_options.own_options(kind):
            assert f"```{{command-options}} {kind.__name__}\n" in PAGE
