"""Rows of numbers in text files, the same for every format."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence

import numpy as np

from gmmtorch.errors import DataError

_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.I | re.A)
# C runtimes print these, Microsoft's older ones rounded to the precision: 1.#QNAN, 1.#INF00, 1.#J, 1.$
_NOT_FINITE = re.compile(
    r"(?<!\S)[+-]?(?:nan(?:[qs]|\(\w*\))|1\.(?:#[a-z]+|\$)0*(?:e[+-]?\d+)?)(?!\S)", re.I | re.A
)
_SHOWN = 40  # characters of a word in an error


def number_rows(lines: Sequence[str], width: int | None, where: str, first: int = 1) -> np.ndarray:
    """Numbers (N, width), float64, of lines that are not blank. White space separates the numbers.

    Numbers are decimal, with a point. NaN and infinity are read in every spelling of C runtimes.

    Args:
        width: numbers in each line; None: as many as in the first line.
        where: beginning of errors, up to the number of the line, as in "a.pcd, row".
        first: number of the first line.

    Raises `DataError`, which names the line and the word, if a word is not a number or a line has another
    width.
    """
    if not lines:
        return np.empty((0, width or 0))
    width = width or len(lines[0].split())
    spellings = (None, _NOT_FINITE) if lines[0].strip() else ()
    for spelling in spellings:  # the second is rare, and takes longer than to read the numbers
        text = lines if spelling is None else [spelling.sub("nan", line) for line in lines]
        with contextlib.suppress(ValueError):
            table = np.loadtxt(text, np.float64, comments=None, ndmin=2)
            if table.shape == (len(lines), width):
                return table
    raise _bad_line(lines, width, where, first)


def _bad_line(lines: Sequence[str], width: int, where: str, first: int) -> DataError:
    """The error for the first line that is not `width` numbers."""
    for number, line in enumerate(lines, first):
        words = _NOT_FINITE.sub("nan", line).split()
        for word in words:
            if not _NUMBER.fullmatch(word):
                remedy = "write decimals with a point, not a comma" if "," in word else "write the file again"
                return DataError(f"{where} {number}: {word[:_SHOWN]!r} is not a number; {remedy}.")
        if len(words) != width:
            return DataError(
                f"{where} {number} has {len(words)} numbers instead of {width}; the file is truncated or "
                "damaged. Write it again."
            )
    return DataError(f"{where} {first} or a later one cannot be read as numbers; write the file again.")
