"""Result rows as plain-text tables."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from gmmtorch.report.quantities import byte_text

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
