"""The tables of docs/commands.md are those of the declarations; its command lines compose."""

from __future__ import annotations

import re
import runpy
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_runs import CHECKOUT, as_it_was, composed

from gmmtorch.cli import localize

PAGE = (CHECKOUT / "docs" / "commands.md").read_text(encoding="utf-8")
PAGES = [CHECKOUT / "README.md", CHECKOUT / "BENCHMARKS.md", *sorted((CHECKOUT / "docs").rglob("*.md"))]
MOST_OPTIONS = 170
"""Distinct options of all commands and choices. A new one needs a document or an experiment that uses it."""


@pytest.fixture(autouse=True)
def hydra_as_it_was() -> Iterator[None]:
    with as_it_was():
        yield


def test_the_tables_are_current_and_have_every_option():
    """Run scripts/option_tables.py to write them."""
    script = runpy.run_path(str(CHECKOUT / "scripts" / "option_tables.py"))
    assert script["written"](PAGE) == PAGE
    names = script["names"]()
    assert not [
        name for name in sorted(names) if f"| `{name}` |" not in PAGE and not name.startswith("study.")
    ]
    assert len(names) <= MOST_OPTIONS


# -- documented command lines ------------------------------------------------------------------------


def command_lines(page: Path) -> list[tuple[str, str]]:
    """Each `gmmtorch-` line of a page's shell blocks: the command, and its arguments."""
    text = page.read_text(encoding="utf-8").replace("\\\n", "")
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    return [
        (found[1], found[2])
        for block in blocks
        for line in block.splitlines()
        if (found := re.match(r"(?:\.venv/bin/|[A-Z_]+=\S+ )*gmmtorch-(\w+)(.*)", line))
    ]


def overrides(arguments: str) -> list[str]:
    """The overrides of a command line; of a sweep, the first value of each."""
    words = shlex.split(arguments.replace("…", ""), comments=True)
    found = [word for word in words if "=" in word and not word.startswith("hydra")]
    return [re.sub(r"=([^,\[{]*),.*", r"=\1", word) for word in found] if "-m" in words else found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_documented_command_lines_compose(page):
    for command, arguments in command_lines(page):
        given = overrides(arguments)
        composed(command, *(localize.overrides(given) if command == "localize" else given))


def test_command_lines_are_found_in_the_pages():
    assert sum(len(command_lines(page)) for page in PAGES) > 50
