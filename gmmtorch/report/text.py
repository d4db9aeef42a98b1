"""Values as short text, result rows as plain-text tables, and the progress of long work as bars."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any

Event = Callable[[str, int, int | None], None]
"""(stage, done, total): the name of the stage, the work done so far, and all its work (None if unknown)."""

Row = dict[str, Any]
"""One row of results.json: values by field."""

OnRows = Callable[[list[Row]], object]
"""Called with all rows so far after each new row, so that a run that fails late keeps its rows."""

_UNITS = (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3))


def byte_text(value: float, digits: int = 3) -> str:
    """Formats a number of bytes with an SI unit: 950 B, 28.1 kB (28,100 bytes), 1.25 MB."""
    for unit, size in _UNITS:
        # The factor avoids "1000 kB": 999.6 kB rounds up to 1.00 MB.
        if abs(value) >= 0.9995 * size:
            return f"{_rounded(value / size, digits)} {unit}"
    return f"{value:.0f} B"


def ratio_text(value: float) -> str:
    """Formats a ratio with three digits: 3.00×."""
    return f"{_rounded(value, 3)}×"


def count_text(n: int, noun: str) -> str:
    """Formats a number of things: 1 point, 2,000 points."""
    return f"{n:,} {noun}" + "s" * (n != 1)


def _rounded(value: float, digits: int) -> str:
    """Rounds to `digits` significant digits, but keeps all digits before the decimal point."""
    if not value:
        return f"{value:.{digits - 1}f}"
    rounded = float(f"{abs(value):.{digits - 1}e}")
    n_before_point = math.floor(math.log10(rounded)) + 1
    return f"{value:.{max(digits - n_before_point, 0)}f}"


_FOUR_DECIMALS = ("accuracy", "auc", "brier", "called", "ece", "recall")


def format_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[str] | None = None) -> str:
    """Formats rows as aligned text: column names, a rule and one line per row; no trailing newline.

    Columns of numbers are right-aligned. Areas, Brier scores and shares have four decimals, bytes have SI
    prefixes (28.1 kB is 28,100 bytes), integers have thousands separators, other numbers have four digits.
    None and missing values are shown as "-".

    Args:
        rows: values by column name: numbers, text, truth values or None.
        columns: names and order of the columns; if None, all columns in order of first occurrence.
    """
    names = list(columns) if columns is not None else list(dict.fromkeys(key for row in rows for key in row))
    if not names:
        return ""
    cells = [[format_value(name, row.get(name)) for name in names] for row in rows]
    right = [any(_is_number(row.get(name)) for row in rows) for name in names]
    widths = [max(len(name), *(len(line[i]) for line in cells), 0) for i, name in enumerate(names)]
    lines = [names, ["-" * width for width in widths], *cells]
    return "\n".join(_aligned(line, widths, right) for line in lines)


def format_value(name: str, value: Any) -> str:
    """Formats one value as a cell of the column `name`."""
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return f"[{len(value)} values]"
    if not _is_number(value):
        return " ".join(str(value).split())
    words = name.split("_")
    if any(word in ("bytes", "nbytes") for word in words) and math.isfinite(value):
        return byte_text(float(value))
    if any(word in words for word in _FOUR_DECIMALS):
        return f"{value:.4f}"
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}"


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _aligned(cells: Sequence[str], widths: Sequence[int], right: Sequence[bool]) -> str:
    padded = (
        cell.rjust(width) if is_right else cell.ljust(width)
        for cell, width, is_right in zip(cells, widths, right, strict=True)
    )
    return "  ".join(padded).rstrip()


def ignore(stage: str, done: int, total: int | None) -> None:
    """The default callback of long work: ignores all events."""


class ProgressBars:
    """Shows events (stage, done, total) as progress bars on standard error.

    The first event of a stage opens a bar. The bar disappears when done reaches total, or when the context
    ends. A stage that starts again opens a new bar.

        with ProgressBars() as progress:
            progress("fit", 3, 10)

    Args:
        enabled: False ignores all events.
    """

    def __init__(self, enabled: bool = True) -> None:
        self.enabled = enabled
        self._bars: dict[str, Any] = {}

    def __call__(self, stage: str, done: int, total: int | None = None) -> None:
        """Shows that `done` of `total` steps of `stage` are done; total None means unknown."""
        if not self.enabled:
            return
        bar = self._bars.get(stage)
        if bar is None:
            bar = self._bars[stage] = _open(stage, total)
        elif done < bar.n:
            bar.reset(total)
        bar.total = total
        bar.update(done - bar.n)
        if total is not None and done >= total:
            self._bars.pop(stage).close()

    def note(self, stage: str, text: str) -> None:
        """Shows text next to the bar of a stage, if that bar is open."""
        if stage in self._bars:
            self._bars[stage].set_postfix_str(text, refresh=False)  # shown with the next step

    @property
    def stages(self) -> tuple[str, ...]:
        """The stages whose bars are open."""
        return tuple(self._bars)

    def close(self) -> None:
        """Closes every bar."""
        while self._bars:
            self._bars.popitem()[1].close()

    def __enter__(self) -> ProgressBars:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _open(stage: str, total: int | None) -> Any:
    from tqdm import tqdm

    return tqdm(desc=stage, total=total, file=sys.stderr, leave=False, dynamic_ncols=True)
