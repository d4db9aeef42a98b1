"""docs/commands.md documents every option of each command with its default; its command lines compose."""

from __future__ import annotations

import functools
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from command_runs import CHECKOUT, as_it_was, composed
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import localize

LINES = (CHECKOUT / "docs" / "commands.md").read_text(encoding="utf-8").splitlines()
PAGES = [CHECKOUT / "README.md", CHECKOUT / "BENCHMARKS.md", *sorted((CHECKOUT / "docs").rglob("*.md"))]
COMMANDS = ["occupancy", "map", "localize", "view", "ros", "fit", "export", "explore", "robot", "team"]
CHOICES = [
    *([command] for command in COMMANDS),
    *(["occupancy", f"dataset={name}"] for name in ("carmen", "depth_frames", "mesh", "mesh_scans")),
    *(["occupancy", "dataset=synthetic_building"], ["fit", "dataset=synthetic_building_2d"]),
    *(["occupancy", f"map={name}"] for name in ("incremental", "windowed", "per_scan")),
    *(["explore", f"world={name}"] for name in ("warehouse", "tunnels", "mesh")),
    *(["explore", f"planner={name}"] for name in ("mcts", "frontier", "random")),
]
SILENT = {"study"}
"""Options that only `experiment=` sets."""
WORDS = {"dataset.max_range", "dataset.no_return_range"}
"""Options whose defaults depend on other options; they are described in words and not compared."""
FREE = {"method_options", "sensor_options", "variants"}
"""Groups with free names."""
STUDIES = {
    "occupancy": [
        "fig3_3_approximation_error",
        "fig3_8_variance_threshold",
        "pose_correction",
        "pruning",
        "tab3_1_auc_memory",
    ],
    "fit": ["automatic_components", "fig2_1_initialization", "sensor_model"],
}


@pytest.fixture(autouse=True)
def hydra_as_it_was() -> Iterator[None]:
    with as_it_was():
        yield


@functools.cache
def configuration(command: str, *overrides: str) -> DictConfig:
    return composed(command, *overrides)


def options(config: DictConfig, prefix: str = "") -> Iterator[str]:
    """Dotted names of all options, without the names of choices."""
    for name in config:
        value = None if OmegaConf.is_missing(config, name) else config[name]
        if isinstance(value, DictConfig) and name not in FREE:
            yield from options(value, f"{prefix}{name}.")
        elif not (prefix and name == "name"):
            yield f"{prefix}{name}"


# -- documented options ----------------------------------------------------------------------------


def section(command: str) -> list[str]:
    """The lines under the heading of a command."""
    first = LINES.index(f"## gmmtorch-{command}")
    last = next(i for i, line in enumerate(LINES) if i > first and line.startswith("## "))
    return LINES[first:last]


def experiment_section(experiment: str) -> list[str]:
    """The row of the table of experiments, or the paragraphs and the table under a bold name."""
    rows = [line for line in LINES if line.startswith(f"| `{experiment}` |")]
    if rows:
        return rows
    first = next(i for i, line in enumerate(LINES) if line.startswith(f"**`experiment={experiment}`**"))
    following = [i for i, line in enumerate(LINES) if i > first and line.startswith("**`experiment=")]
    return LINES[first : following[0] if following else None]


def names_option(name: str, line: str) -> bool:
    """Whether a line names an option, in full or as `.last` after another option of its group."""
    group, _, last = name.rpartition(".")
    return (
        f"`{name}`" in line
        or f"`{name}=" in line
        or bool(group and f"`{group}." in line and f"`.{last}`" in line)
    )


def is_documented(name: str, command: str) -> bool:
    """Whether a table of the command's section, or of a section that it refers to, has the option."""
    if any(line.startswith("|") and names_option(name, line) for line in section(command)):
        return True
    if name.startswith("log.map."):  # "as `map` above"
        return is_documented("log.map", command) and is_documented(name.removeprefix("log."), "occupancy")
    text = " ".join(section(command))
    if found := re.search(r"Options are those of `gmmtorch-(\w+)`", text):
        return is_documented(name, found[1])
    names = r"((?:`[\w.]+`(?:, | and )?)+) are (?:as above|those of `gmmtorch-(\w+)`)"
    return any(
        is_documented(name, other or "occupancy")
        for shared, other in re.findall(names, text)
        if name.split(".")[0] in re.findall(r"[\w.]+", shared.replace(" and ", " "))
    )


@pytest.mark.parametrize("chosen", CHOICES, ids=" ".join)
def test_every_option_is_documented_in_the_section_of_its_command(chosen):
    names = set(options(configuration(*chosen))) - SILENT
    assert len(names) > 5
    assert not {name for name in names if not is_documented(name, chosen[0])}


@pytest.mark.parametrize(("command", "name"), [(c, name) for c, names in STUDIES.items() for name in names])
def test_every_option_of_a_study_is_documented_with_the_study(command, name):
    config = configuration(command, f"experiment={name}")
    lines = experiment_section(name)
    found = [option for option in options(config) if option.startswith("study.")]
    assert found
    assert not [option for option in found if not any(names_option(option, line) for line in lines)]


# -- documented defaults -----------------------------------------------------------------------------


class Row(NamedTuple):
    """A row of a table of options: its option names, its cell of defaults, and the overrides they need."""

    command: str
    chosen: tuple[str, ...]
    names: list[str]
    defaults: str


def rows() -> Iterator[Row]:
    """The rows of all tables of options."""
    command, chosen, is_table = "", (), False
    for line in LINES:
        if heading := re.match(r"## gmmtorch-(\w+)", line):
            command, chosen = heading[1], ()
        if heading := re.match(r"\*\*`experiment=(\w+)`\*\*", line):
            command, chosen = "fit", (f"experiment={heading[1]}",)
        is_table = line.startswith("|") and (is_table or line == "| option | default | meaning |")
        cells = [cell.strip() for cell in line[1:-1].split("|")]
        if not is_table or line.startswith(("| option", "|---")):
            continue
        if group := re.match(r"\*\*`(map=\w+)`\*\*", cells[0]):
            chosen = (group[1],)
            continue
        if cells[0].startswith("`evaluation."):  # the rows of maps end here
            chosen = ()
        dataset = re.match(r"`(depth_frames|mesh|mesh_scans)`:", cells[2])
        yield Row(command, (f"dataset={dataset[1]}",) if dataset else chosen, full_names(cells[0]), cells[1])


def full_names(cell: str) -> list[str]:
    """Expands `a.b`, `.c` to a.b and a.c."""
    names: list[str] = []
    for name in re.findall(r"`([^`]+)`", cell):
        names.append(f"{names[-1].rpartition('.')[0]}{name}" if name.startswith(".") else name)
    return names


def values(cell: str) -> list[Any]:
    """The values of a cell, which are separated by commas outside of brackets."""
    return [value_of(text) for text in re.findall(r"(?:\[[^]]*\]|\{[^}]*\}|[^,[{])+", cell)]


def value_of(text: str) -> Any:
    text = text.strip().strip("`")
    if text.endswith(" GiB"):
        return int(text.removesuffix(" GiB")) << 30
    try:
        return float(text)
    except ValueError:
        return yaml.safe_load(text)


def is_value(config: DictConfig, name: str, said: Any) -> bool:
    """Whether an option has this value, or a group this choice. Numbers may be rounded to 0.1 %."""
    value = OmegaConf.select(config, name, throw_on_missing=False)
    if isinstance(value, DictConfig) and "name" in value:
        return bool(value.name == said)
    value = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
    if isinstance(said, float) and isinstance(value, int | float):
        return bool(value == pytest.approx(said, rel=1e-3))
    return bool(value == said)


@pytest.mark.parametrize("command", COMMANDS)
def test_documented_defaults_match_the_configuration(command):
    compared, wrong = 0, []
    for row in rows():
        in_words = not row.defaults or set(row.names) <= WORDS or row.names == ["experiment"]
        if row.command != command or in_words:
            continue
        config, said = configuration(command, *row.chosen), values(row.defaults)
        said = said * len(row.names) if len(said) == 1 else said
        assert len(said) == len(row.names), row
        known = set(options(config)) | set(config)
        for name, value in zip(row.names, said, strict=True):
            there = name in known or name.endswith((".dataset", ".map"))
            if not (there and is_value(config, name, value)):
                wrong.append((name, value))
            compared += 1
    assert not wrong
    assert compared > 1


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
