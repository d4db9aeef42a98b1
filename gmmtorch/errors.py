"""One family of errors. Every message names the argument or file, its value, and the remedy."""

from __future__ import annotations

import numbers


class GmmTorchError(Exception):
    """Base of every error that gmmtorch raises on purpose."""


class InvalidArgumentError(GmmTorchError, ValueError):
    """An argument has a value that cannot be worked with."""


class DataError(GmmTorchError, ValueError):
    """A file or an array does not hold what it should."""


class MissingDataError(GmmTorchError, FileNotFoundError):
    """A file or folder that was asked for does not exist."""

    def __str__(self) -> str:  # FileNotFoundError would print a bare tuple
        return str(self.args[0]) if self.args else ""


class OutputError(GmmTorchError, OSError):
    """A file could not be written."""

    def __str__(self) -> str:  # OSError would print a bare tuple
        return str(self.args[0]) if self.args else ""


class MemoryLimitError(GmmTorchError, MemoryError):
    """What was asked for does not fit into the memory allowed for it."""


class NumericalError(GmmTorchError, ArithmeticError):
    """A matrix could not be factorised, even with the largest permitted jitter."""


def check_whole(name: str, value: object, least: int) -> int:
    """`value` as a whole number of at least `least`, below 2⁶³; else `InvalidArgumentError`."""
    if not isinstance(value, numbers.Integral) or not least <= int(value) < 2**63:
        raise InvalidArgumentError(f"{name}={value!r} must be a whole number of at least {least}.")
    return int(value)
