"""Options: fields of dataclasses that a command offers. Importing this file loads nothing heavy.

An option is declared once, as a field of the dataclass that it configures:

    noise: float = option(0.01, "standard deviation (m) of the range sensor")

Its type, its default and its sentence make the schema of the command line, the help, and the tables of the
documentation. A field that is declared in another way is for Python only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, Field, field, fields
from typing import Any, NamedTuple

_KEY = "option"


class About(NamedTuple):
    """What a field says about itself.

    text: its sentence; "" for a group. name: its dotted name in the command; None: the field's name.
    options, defaults: of a group: the dataclass that declares them, and their defaults that differ.
    """

    text: str
    name: str | None = None
    options: Any = None
    defaults: dict[str, Any] | None = None


def option(default: Any, about: str, name: str | None = None) -> Any:
    """A field that is an option.

    Args:
        default: a list or dict is copied for each object. `MISSING`: the option must be given.
        about: what it means: units, range, choices.
        name: dotted name of the option, if it is not that of the field, as in planner.prior.
    """
    kept = {_KEY: About(about, name)}
    if isinstance(default, list | dict):
        return field(default_factory=default.copy, metadata=kept)
    return field(default=default, metadata=kept)


def repeated(cls: Any, name: str, default: Any) -> Any:
    """A field with the sentence of the field `name` of another dataclass, and a default of its own."""
    about: About = next(item.metadata[_KEY] for item in fields(cls) if item.name == name)
    return option(default, about.text)


def group(options: Any, name: str | None = None, make: Any = None, **defaults: Any) -> Any:
    """A field with a dataclass whose options are a group.

    Args:
        options: the dataclass that declares them, or a base of it that loads nothing heavy.
        name: of the group, if it is not that of the field; "": the options have no prefix.
        make: makes the default of the field, if it is not that of `options`.
        defaults: defaults that differ from those of `options`; by the names of its fields.
    """
    kept = {_KEY: About("", name, options, defaults)}
    return field(default_factory=make or (lambda: options(**defaults)), metadata=kept)


def declared(cls: Any) -> Iterator[tuple[Field[Any], About]]:
    """The fields of a dataclass that are options or groups of options."""
    for item in fields(cls):
        if (about := item.metadata.get(_KEY)) is not None:
            yield item, about


def default_of(item: Field[Any]) -> Any:
    """The default of a field; `dataclasses.MISSING` without one."""
    return item.default if item.default_factory is MISSING else item.default_factory()
