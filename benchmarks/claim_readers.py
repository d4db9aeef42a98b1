"""Reads claimed numbers from pages and measured numbers from the output of runs; intervals for both.

In the text of a claim, # stands for a number and … for anything within the line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import fmean
from typing import Any

from pages import ROOT

from gmmtorch.experiments.harness import Table

_NUMBER = r"[-−+]?(?:\d+(?:,\d{3})*(?:\.\d+)?|\.\d+)"
Interval = Callable[[float], tuple[float, float]]
Reader = Callable[[Path], list[float]]  # of the folder of a run


def within(difference: float) -> Interval:
    return lambda claimed: (claimed - difference, claimed + difference)


def times(factor: float) -> Interval:
    return lambda claimed: (claimed / factor, claimed * factor)


def at_least(share: float = 1.0) -> Interval:
    return lambda claimed: (share * claimed, math.inf)


def at_most(factor: float = 1.0) -> Interval:
    return lambda claimed: (-math.inf, factor * claimed)


def score(claimed: float) -> tuple[float, float]:
    """Of an AUC ± 0.003, because rounding differs between machines; of a size or a count ± a twentieth."""
    return within(0.003)(claimed) if claimed < 1 else times(1.05)(claimed)


def section(page: str) -> str:
    """The text of a page, of `page#part`, the part below a heading, or of a table of results in a page."""
    path, _, part = page.partition("#")
    if path.endswith(".json"):
        return Table.load(ROOT / path).markdown()
    text = (ROOT / path).read_text(encoding="utf-8")
    if not part:
        return text
    found = re.search(rf"^(#+) {re.escape(part)}.*?(?=^\1 |\Z)", text, re.DOTALL | re.MULTILINE)
    return found[0] if found else ""


def numbers(text: str, where: str) -> list[float]:
    """The numbers at each # of a text, which must occur once."""
    pattern = re.escape(text).replace(r"\#", "#").replace("#", f"({_NUMBER})").replace("…", "[^\n]*?")
    found = list(re.finditer(pattern, where))
    if len(found) != 1:
        raise ValueError(f"this text occurs {len(found)} times, not once: {text}")
    return [_number(group) for group in found[0].groups()]


def _number(text: str) -> float:
    return float(text.replace(",", "").replace("−", "-"))


def cell_texts(row: dict[str, str], keys: int, columns: Sequence[str]) -> str:
    """A row of a table as the text of a claim: its label, # for numbers of the columns, … for the rest."""
    cells = [re.sub(_NUMBER, "#", value) if header in columns else "…" for header, value in row.items()]
    return f"| {' | '.join([*list(row.values())[:keys], *cells[keys:]])} |"


def count_of_numbers(text: str) -> int:
    return len(re.findall(_NUMBER, text))


def published(mark: str, label: Sequence[str], *columns: str) -> Reader:
    """The numbers in cells of a table that a run writes, of the row that begins with a label."""

    def read(out: Path) -> list[float]:
        rows = Table.load(out / f"{mark}.json").texts()
        chosen = [row for row in rows if list(row.values())[: len(label)] == list(label)]
        if len(chosen) != 1:
            raise ValueError(f"the run writes {len(chosen)} rows {', '.join(label)}, not one")
        return [_number(found) for column in columns for found in re.findall(_NUMBER, chosen[0][column])]

    return read


def printed(text: str) -> Reader:
    """The numbers in what a command prints."""
    return lambda out: numbers(text, (out / "stdout").read_text(encoding="utf-8"))


def result(field: str, scale: float = 1.0, **where: Any) -> Reader:
    """Means of a field of results.json over the rows with these values; of a tuple, one for each value."""
    several = [name for name, value in where.items() if isinstance(value, tuple)]

    def read(out: Path) -> list[float]:
        rows = json.loads((out / "results.json").read_text(encoding="utf-8"))["rows"]
        choices = [{**where, several[0]: value} for value in where[several[0]]] if several else [where]
        chosen = [
            [_value(row, field) for row in rows if all(row.get(name) == value for name, value in one.items())]
            for one in choices
        ]
        return [scale * fmean(value for value in values if value is not None) for values in chosen]

    return read


def _value(row: dict[str, Any], field: str) -> Any:
    """Of a row, or of a dictionary in it: `field.key`."""
    name, _, key = field.partition(".")
    return row[name][key] if key else row[name]


def joined(*readers: Reader) -> Reader:
    return lambda out: [value for read in readers for value in read(out)]


def ratio(over: Reader, under: Reader) -> Reader:
    return lambda out: [a / b for a, b in zip(over(out), under(out), strict=True)]


def difference(of: Reader, less: Reader) -> Reader:
    return lambda out: [a - b for a, b in zip(of(out), less(out), strict=True)]


def reduced(function: Callable[[Iterable[float]], float], read: Reader) -> Reader:
    """One number of several, such as the least: `reduced(min, …)`."""
    return lambda out: [function(read(out))]
