"""Bytes, ratios and counts as short text."""

from __future__ import annotations

import math

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
