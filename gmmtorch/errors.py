"""The error classes of gmmtorch. Every message names the argument or file, its value, and the remedy."""

from __future__ import annotations

import math
import numbers
from collections.abc import Collection

_LARGEST_CELL = 1e9  # metres; powers of larger sides overflow


class GmmTorchError(Exception):
    """Base class of all errors that gmmtorch raises deliberately.

    Their text is one line that is safe to print: control characters, as in a file's name, are escaped.
    """

    def __str__(self) -> str:  # also because OSError would print a bare tuple
        text = str(self.args[0]) if self.args else ""
        return "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


class InvalidArgumentError(GmmTorchError, ValueError):
    """An argument has an invalid value."""


class DataError(GmmTorchError, ValueError):
    """The content of a file or array is invalid."""


class MissingDataError(GmmTorchError, FileNotFoundError):
    """A requested file or folder does not exist."""


class OutputError(GmmTorchError, OSError):
    """A file could not be written."""


class MemoryLimitError(GmmTorchError, MemoryError):
    """A request does not fit into the memory allowed for it."""


class NumericalError(GmmTorchError, ArithmeticError, ValueError):
    """A matrix cannot be factorised, even with the largest permitted jitter."""


def check_whole(name: str, value: object, least: int, most: int = 2**63 - 1) -> int:
    """Returns `value` as an int.

    Raises `InvalidArgumentError` unless it is a whole number from `least` to `most`.
    """
    if not isinstance(value, numbers.Integral) or not least <= int(value) <= most:
        limits = f"of at least {least}" if most == 2**63 - 1 else f"from {least} to {most}"
        raise InvalidArgumentError(f"{name}={value!r} must be a whole number {limits}.")
    return int(value)


def check_number(
    name: str, value: object, largest: float = math.inf, above: bool = False, *, least: float = 0.0
) -> float:
    """Returns `value` as a float.

    Raises `InvalidArgumentError` unless it is a finite number from `least` (exclusive if `above`) to
    `largest`.
    """
    number = _as_float(value)
    if not (least <= number <= largest and number < math.inf) or (above and number == least):
        limit = f"from {least:g} to {largest:g}" if largest < math.inf else f"of at least {least:g}"
        raise InvalidArgumentError(
            f"{name}={value!r} must be a finite number {f'above {least:g}' if above else limit}."
        )
    return number


def _as_float(value: object) -> float:
    """The value of a real number; NaN for anything else."""
    return float(value) if isinstance(value, numbers.Real) else math.nan


def check_choice(name: str, value: object, choices: Collection[str]) -> None:
    """Raise `InvalidArgumentError`, which lists the choices, unless `value` is one of them."""
    if not isinstance(value, str) or value not in choices:
        raise InvalidArgumentError(f"{name}={value!r} is not one of {', '.join(choices)}.")


def check_resolution(resolution: float) -> float:
    """Returns the cell size as a float. Raises `InvalidArgumentError` unless it is finite and above zero."""
    value = _as_float(resolution)
    if not 0 < value <= _LARGEST_CELL:
        raise InvalidArgumentError(
            f"resolution={resolution!r} is not a cell size; give metres above zero, such as 0.1."
        )
    return value


def check_prior(prior: float) -> float:
    """Returns the prior count as a float.

    Raises `InvalidArgumentError` unless it is finite and at least zero.
    """
    value = _as_float(prior)
    if not (math.isfinite(value) and value >= 0):
        raise InvalidArgumentError(f"prior={prior!r} must be a count of at least zero; the thesis uses 1.")
    return value
