"""The documents keep their promises: commands parse, links lead somewhere, copied figures agree."""

import re
import shlex
import tomllib
from importlib import metadata
from pathlib import Path
from textwrap import dedent

import pytest
import yaml
from packaging.specifiers import Specifier, SpecifierSet
from packaging.utils import canonicalize_name

import nodeslam
from app.cli import parse
from app.options import COMMANDS

ROOT = Path(__file__).parents[2]
DOCUMENTS = [
    *sorted(ROOT.glob("*.md")),
    *sorted(p for p in (ROOT / "docs").rglob("*.md") if not {"_build", "generated"} & set(p.parts)),
    *sorted((ROOT / "perception" / "weights").glob("*.md")),
]
IDS = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
PLACEHOLDERS = {"N": "3", "COMMAND": "doctor", "NAME": "panda", "NAME|FILE.toml": "panda"}
RESULTS = (ROOT / "docs" / "results.md").read_text("utf-8")
README = (ROOT / "README.md").read_text("utf-8")


def code_blocks(text):
    return re.findall(r"^```[^\n{]*\n(.*?)^```", text, re.M | re.S)


def inline_code(text):
    without_blocks = re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", without_blocks)]


def command_lines(text):
    """Complete commands: the lines of code blocks, and inline code with arguments."""
    lines = [line.split("  #")[0].strip() for block in code_blocks(text) for line in block.splitlines()]
    return [code for code in lines + inline_code(text) if re.match(r"nodeslam [a-z]", code)]


def is_named_only(words):
    """Whether inline code names a command that needs an argument, as `nodeslam export`, and gives none."""
    return len(words) == 1 and words[0] in COMMANDS


def all_flags():
    fields = {name for kind in COMMANDS.values() for name in kind.__dataclass_fields__}
    return {"--" + name.replace("_", "-") for name in fields} | {"--help"}


@pytest.mark.parametrize("path", DOCUMENTS, ids=IDS)
def test_commands_parse(path):
    for command in command_lines(path.read_text("utf-8")):
        words = [PLACEHOLDERS.get(word, word) for word in shlex.split(command)[1:]]
        if not is_named_only(words):
            parse(words)


@pytest.mark.parametrize("path", DOCUMENTS, ids=IDS)
def test_options_exist(path):
    fragments = [code for code in inline_code(path.read_text("utf-8")) if code.startswith("--")]
    flags = {flag for code in fragments for flag in re.findall(r"(?:^|(?<=\s))--[a-z][a-z-]*", code)}
    assert flags <= all_flags() | {"--index-url", "--extra-index-url"}


@pytest.mark.parametrize("path", DOCUMENTS, ids=IDS)
def test_links_lead_to_files_and_headings(path):
    text = re.sub(r"^```.*?^```", "", path.read_text("utf-8"), flags=re.M | re.S)
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([\w-]+))?\)", text):
        if target.startswith(("http://", "https://")):
            continue
        file = (path.parent / target).resolve() if target else path
        assert file.exists(), f"{path.name} links to {target}, which does not exist"
        if anchor:
            assert anchor in anchors(file.read_text("utf-8")), f"{path.name} links to {target}#{anchor}"


def anchors(text):
    """Labels, and headings as GitHub and MyST make anchors of them."""
    headings = re.findall(r"^#+ (.+)$", text, re.M)
    slugs = {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}
    return slugs | set(re.findall(r"^\(([\w-]+)\)=$", text, re.M))


def summary(text):
    """The rows of the table of results: claim, figures, link."""
    rows = re.findall(r"^\| (.+) \| (.+) \| \[.+\]\((?:docs/)?results\.md#(.+)\) \|$", text, re.M)
    assert len(rows) >= 5
    return rows


def test_the_readme_is_short():
    assert len(README.splitlines()) <= 130


def test_the_readme_copies_the_summary_of_the_results():
    assert summary(README) == summary(RESULTS)


def test_the_summary_copies_figures_of_the_sections_that_it_links_to():
    for claim, figures, label in summary(RESULTS):
        section = re.search(rf"^\({label}\)=\n(.*?)(?=^\([\w-]+\)=$|\Z)", RESULTS, re.M | re.S)
        assert section, f"docs/results.md has no section ({label})="
        for figure in re.findall(r"\d+ of \d+|\d[\d.]*\d|\d", figures):
            assert re.search(rf"(?<![\d.]){re.escape(figure)}(?![\d.]*\d)", section.group(1)), (
                f"{claim}: {figure} is not in the section {label}"
            )


def test_the_metadata_agree():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {project['version']}\n" in citation
    assert f"\nlicense: {project['license']}\n" in citation
    assert "Apache License\n" in (ROOT / "LICENSE").read_text("utf-8")
    assert "## [Unreleased]" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_continuous_integration_runs_the_gate_of_this_repository():
    workflow = (ROOT / ".github" / "workflows" / "ci.yml").read_text("utf-8")
    assert "run: .ci/run\n" in workflow and "run: make docs\n" in workflow
    makefile = (ROOT / "Makefile").read_text("utf-8")
    assert re.search(r"^docs: setup\n(?:\t.*\n)*\t.*sphinx-build -W ", makefile, re.M)
    assert re.search(r"-e '\.\[.*\bdocs\b.*\]'", makefile)


@pytest.mark.parametrize("name", [".github/workflows/ci.yml", ".pre-commit-config.yaml", "CITATION.cff"])
def test_configuration_is_valid_yaml(name):
    assert isinstance(yaml.safe_load((ROOT / name).read_text("utf-8")), dict)


def test_every_pin_but_the_build_of_pytorch_has_a_digest():
    pins = (ROOT / "requirements.lock").read_text("utf-8").split()
    digests = (ROOT / ".ci" / "requirements.hashes").read_text("utf-8")
    hashed = re.findall(r"^(\S+==\S+) --hash=sha256:[0-9a-f]{64}$", digests, re.M)
    assert hashed == [pin for pin in pins if not pin.startswith("torch==")], "run .ci/update-hashes"


def test_every_pin_suits_the_least_python():
    """The lock is written with a later Python, whose releases another one with the same minor may lack."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    least = Specifier(project["requires-python"].split(",")[0]).version + ".0"
    installed = {canonicalize_name(d.metadata["Name"]): d for d in metadata.distributions()}
    unsuited, judged = [], 0
    for pin in (ROOT / "requirements.lock").read_text("utf-8").split():
        name, version = pin.split("==")
        found = installed.get(canonicalize_name(name))
        if found is None or found.version != version:
            continue  # this environment was not installed from the lock
        judged += 1
        needed = found.metadata.get("Requires-Python")
        if needed and not SpecifierSet(needed).contains(least):
            unsuited.append(f"{pin} requires Python {needed}")
    assert not unsuited and judged


def test_every_dependency_of_the_documentation_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    lock = (ROOT / "requirements.lock").read_text("utf-8").lower()
    for requirement in project["optional-dependencies"]["docs"]:
        name = re.split(r"[<>=!]", requirement)[0]
        assert re.search(rf"^{name}==", lock, re.M), f"{name} is not in requirements.lock"


def test_the_readme_prints_the_example_of_the_public_interface():
    example = re.search(r"::\n\n((?: {4}.*\n|\n)+)", nodeslam.__doc__).group(1)
    assert (
        re.search(r"^```python\n(.*?)^```", README, re.M | re.S).group(1) == dedent(example).rstrip() + "\n"
    )


def test_the_reference_has_every_public_name_once():
    page = (ROOT / "docs" / "api" / "nodeslam.md").read_text("utf-8")
    described = re.findall(r"^\.\. auto\w+:: nodeslam\.(\w+)$", page, re.M)
    assert sorted(described) == sorted(set(nodeslam.__all__) - {"__version__"})


def test_the_python_guide_shows_every_example():
    guide = (ROOT / "docs" / "python.md").read_text("utf-8")
    examples = sorted(path.name for path in (ROOT / "examples").glob("[0-9]*.py"))
    assert re.findall(r"^```{literalinclude} \.\./examples/(.+)$", guide, re.M) == examples != []
