"""The error classes of gmmtorch. Every message names the argument or file, its value, and the remedy."""

from __future__ import annotations

import math
import numbers
import re
from collections.abc import Collection, Mapping
from typing import Self

_SHOWN = 4000  # characters of the beginning and of the end of a longer message
_LARGEST_CELL = 1e9  # metres; powers of larger sides overflow
_MARKED = re.compile(r"‹([\w.]+)›")
_HEAD = re.compile(r"‹([\w.]+)›|([\w.]+)(?=(?:\[\d+\](?:\.\w+)?)?=)")
_REST = re.compile(
    r"(?:\[\d+\](?:\.\w+)?)?(?:=(?P<value>.*?))?:? "
    r"(?P<fault>(?:The '\w+' parameter|must|is|are|has|needs|does|cannot|would)\b.*?)(?:; (?P<remedy>.*))?"
)
"""The argument at the beginning of a text; and =value fault; remedy, of the argument or of one entry."""

DAMAGED_CONTENT = LookupError, TypeError, ValueError, ArithmeticError, RuntimeError, AttributeError
"""What code raises that uses values of a file whose types and sizes are not as they were written."""


def arg(name: str) -> str:
    """The name of an argument in the text of an error, marked so that a command can show its option."""
    return f"‹{name}›"


def told(text: str, names: Mapping[str, str] | None = None) -> str:
    """A text with marked arguments (`arg`) as the user reads it. names: what an argument is called; its own
    name if it is not there."""
    return _MARKED.sub(lambda found: (names or {}).get(found[1], found[1]), text)


def printable(text: str) -> str:
    """A text whose control characters, such as those of a terminal, are escaped."""
    return text if text.isprintable() else "".join(c if c.isprintable() else repr(c)[1:-1] for c in text)


def text_of(error: Exception) -> str:
    """The text of an error with its marks, for `told`."""
    return str(error.args[0]) if error.args else ""


class GmmTorchError(Exception):
    """Base class of all errors that gmmtorch raises deliberately.

    Their text is one line that is safe to print: control characters, as in a file's name, are escaped, and
    the middle of a very long text, as that of a damaged number, is left out.
    The error of an argument says `argument=value fault; remedy`.
    """

    @classmethod
    def of(cls, argument: str, value: object, fault: str, remedy: str = "") -> Self:
        """The error of an argument: its name, its value, what is wrong with it, and what to do."""
        return cls(f"{arg(argument)}={value} {fault}{'; ' if remedy else ''}{remedy}.")

    @property
    def argument(self) -> str | None:
        """The argument's name in Python; None if the error is of something else."""
        found = _HEAD.match(text_of(self))
        return (found[1] or found[2]) if found else None

    @property
    def value(self) -> str | None:
        """The argument's value, as the text shows it."""
        return self._part("value")

    @property
    def fault(self) -> str | None:
        """What is wrong with the value."""
        return self._part("fault")

    @property
    def remedy(self) -> str | None:
        """What to do; None if the fault says it."""
        return self._part("remedy")

    def _part(self, name: str) -> str | None:
        head = _HEAD.match(text_of(self))
        found = _REST.fullmatch(text_of(self), head.end()) if head else None
        return told(found[name]) if found and found[name] else None

    def told(self, names: Mapping[str, str]) -> Self:
        """The same error with other names for its argument and for the marked ones, such as options.

        Arguments that are not in `names` stay marked.
        """
        text, argument = text_of(self), self.argument
        if argument is not None and argument in names and not text.startswith("‹"):
            text = arg(argument) + text.removeprefix(argument)
        return type(self)(_MARKED.sub(lambda found: names.get(found[1], found[0]), text))

    def __str__(self) -> str:  # also because OSError would print a bare tuple
        return told(format(self))

    def __format__(self, spec: str) -> str:
        """The text for another error, with its marks."""
        text = printable(text_of(self))
        return text if len(text) <= 2 * _SHOWN else f"{text[:_SHOWN]} … {text[-_SHOWN:]}"


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
    try:
        return float(value) if isinstance(value, numbers.Real) else math.nan
    except OverflowError:  # a whole number beyond float64
        return math.inf


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
