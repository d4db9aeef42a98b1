#!/usr/bin/env python3
"""Writes the tables of options in docs/commands.md from the declarations of the options, and counts them.

A table stands between `<!-- options COMMAND: NAME … -->` and `<!-- end -->`: the options of a command with
these first parts of their names, with all choices of groups.
"""

from __future__ import annotations

import functools
import importlib
import re
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from gmmtorch.cli import options_help

PAGE = Path(__file__).resolve().parents[1] / "docs" / "commands.md"
HOMES = {
    "cli": ("map", "view", "localize", "export"),
    "experiments.cli": ("fit", "occupancy"),
    "team.cli": ("ros", "explore", "robot", "team"),
}
COMMANDS = {name: f"gmmtorch.{home}.{name}" for home, names in HOMES.items() for name in names}
_TABLE = re.compile(r"(<!-- options (\w+): ([\w. ]+) -->\n).*?(<!-- end -->)", re.DOTALL)


class Row(NamedTuple):
    """An option, its sentence, and its default with each choice that has it."""

    name: str
    about: str
    defaults: dict[str, str]


def _register() -> None:
    for module in COMMANDS.values():
        importlib.import_module(module).register()


@functools.cache
def groups_of(command: str) -> dict[str, list[str]]:
    """The choices of the groups of a command, by the first part of the names of their options."""
    _register()
    groups = {name: chosen for name, chosen in options_help.groups_of(command).items() if "@" not in name}
    return {{"experiment": "study"}.get(name, name): chosen for name, chosen in groups.items()}


@functools.cache
def rows_of(command: str, first: str) -> list[Row]:
    """The options of every choice of a group of a command, or ("") those that are of no group."""
    groups, found = groups_of(command), dict[str, Row]()
    group = {"study": "experiment"}.get(first, first)
    for choice in groups.get(first, [""]):
        config = options_help.configuration(command, [f"{group}={choice}"] if group else [])
        for option in options_help.options_of(config):
            part = option.name.split(".")[0]
            if part == first or (not first and part not in groups):
                row = found.setdefault(option.name, Row(option.name, option.about, {}))
                row.defaults[choice] = options_help.text_of_value(option.value)
    return list(found.values())


def table(command: str, parts: list[str]) -> str:
    """The table of the options whose names begin with these parts."""
    lines = ["| option | default | meaning |", "|---|---|---|"]
    groups = groups_of(command)
    chosen = options_help.configuration(command).hydra.runtime.choices
    for name in parts:
        if name in groups and name != "study":
            lines.append(f"| `{name}` | `{chosen[name]}` | {', '.join(f'`{c}`' for c in groups[name])} |")
    wanted = ["", *(first for first in groups if first in parts)]
    for row in (row for first in wanted for row in rows_of(command, first)):
        first = row.name.split(".")[0]
        if first not in parts:
            continue
        only = _only(row, groups.get(first, []))
        lines.append(f"| `{row.name}` | {_default(row)} | {only}{row.about.replace('|', chr(92) + '|')} |")
    return "\n".join(lines)


def _only(row: Row, choices: list[str]) -> str:
    with_it = [choice for choice in choices if choice in row.defaults]
    return f"{', '.join(f'`{c}`' for c in with_it)}: " if 0 < len(with_it) < len(choices) else ""


def _default(row: Row) -> str:
    """The default that most choices have, and those of the others."""
    counts = Counter(row.defaults.values())
    usual = counts.most_common(1)[0][0]
    others = [f"{choice}: `{value}`" for choice, value in row.defaults.items() if value != usual]
    shown = "" if usual == "???" else f"`{usual}`"
    return "; ".join([shown, *others]) if shown else ""


def written(page: str) -> str:
    """The page with its tables as the declarations have them."""
    return _TABLE.sub(lambda m: f"{m[1]}{table(m[2], m[3].split())}\n{m[4]}", page)


def names() -> set[str]:
    """The distinct names of the options of all commands, with every choice of their groups."""
    # A group with the same choices has the same options in every command.
    groups = {
        (first, *chosen): (command, first)
        for command in COMMANDS
        for first, chosen in groups_of(command).items()
    }
    wanted = [*((command, "") for command in COMMANDS), *groups.values()]
    return {row.name for command, first in wanted for row in rows_of(command, first)}


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8")), encoding="utf-8")
    print(f"{len(names())} options")
