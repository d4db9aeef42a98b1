"""Quantities as text: bytes and ratios, to a few digits."""

from __future__ import annotations

import math

_UNITS = (("TB", 1e12), ("GB", 1e9), ("MB", 1e6), ("kB", 1e3))


def byte_text(value: float, digits: int = 3) -> str:
    """Bytes in a unit of which there are fewer than a thousand: 950 B, 28.1 kB (28,100 bytes), 1.25 MB."""
    for unit, size in _UNITS:
        # 999.6 would round to 1000 of the unit below, which is 1.00 of this one.
        if abs(value) >= 0.9995 * size:
            return f"{_rounded(value / size, digits)} {unit}"
    return f"{value:.0f} B"


def ratio_text(value: float) -> str:
    """So many times as much, to three digits: 3.00×."""
    return f"{_rounded(value, 3)}×"


def _rounded(value: float, digits: int) -> str:
    """To so many significant digits, never fewer than stand before the point."""
    if not value:
        return f"{value:.{digits - 1}f}"
    rounded = float(f"{abs(value):.{digits - 1}e}")
    before = math.floor(math.log10(rounded)) + 1
    return f"{value:.{max(digits - before, 0)}f}"
