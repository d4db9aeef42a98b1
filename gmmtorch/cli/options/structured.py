"""Hydra schemas from the library's dataclasses, and objects of these classes from a configuration."""

from __future__ import annotations

import ast
import contextlib
import functools
import operator
from collections.abc import Collection, Mapping, Sequence
from dataclasses import MISSING, Field, field, fields, is_dataclass, make_dataclass
from pathlib import Path
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

import gmmtorch
from gmmtorch.cli import common
from gmmtorch.errors import InvalidArgumentError

T = TypeVar("T")
DOCUMENTED = "documented_fields"
"""Attribute of a schema: names that its docstring describes, also those that are not options."""


def schema_of(*classes: type, without: Collection[str] = (), **more: Any) -> type:
    """A dataclass that OmegaConf accepts as a schema, with the fields and defaults of these dataclasses.

    OmegaConf supports neither frozen dataclasses nor `Literal`, tuples or optional dataclasses. They become
    plain dataclasses, str, lists and `Any`; `build` checks their values.

    Args:
        classes: dataclasses; a later class replaces fields of an earlier one.
        without: names of fields that are not options.
        more: further options. A value is the option's default and gives its type, or it replaces the default
            of a field. A dataclass is a group of options.
    """
    found: dict[str, tuple[str, Any, Any]] = {}
    for cls in classes:
        hints = get_type_hints(cls)
        for item in fields(cls):
            if item.name not in without:
                found[item.name] = (item.name, _accepted(hints[item.name]), _default(item))
    for name, value in more.items():
        if isinstance(value, type):
            found[name] = (name, value, field(default_factory=value))
        else:
            hint = found[name][1] if name in found else type(value)
            found[name] = (name, hint, field(default=value))
    made = make_dataclass(classes[0].__name__, found.values())
    made.__doc__ = "\n\n".join(cls.__doc__ or "" for cls in classes)
    documented = [name for cls in classes for name in getattr(cls, DOCUMENTED, cls.__annotations__)]
    setattr(made, DOCUMENTED, documented)
    return made


def read_dataclass(module: str, name: str, **hints: Any) -> type:
    """A dataclass of a module that loads torch, made from its source: fields, defaults and docstring.

    Args:
        module: dotted name in gmmtorch.
        hints: types of fields whose own types are not built in.
    """
    source = _source_of(module, name)
    found: list[Any] = []
    for item in source.body:
        if isinstance(item, ast.AnnAssign) and not ast.unparse(item.annotation).startswith("InitVar"):
            assert isinstance(item.target, ast.Name) and item.value is not None  # noqa: PT018
            field_name, value = item.target.id, ast.literal_eval(item.value)
            hint = hints.get(field_name) or eval(ast.unparse(item.annotation))
            default: Any = field(default_factory=functools.partial(list, value))
            found.append((field_name, hint, default if isinstance(value, tuple) else field(default=value)))
    made = make_dataclass(name, found)
    made.__doc__ = ast.get_docstring(source)
    setattr(
        made,
        DOCUMENTED,
        [ast.unparse(item.target) for item in source.body if isinstance(item, ast.AnnAssign)],
    )
    return made


def read_defaults(module: str, name: str) -> dict[str, Any]:
    """The literal defaults of the fields of a dataclass, read from its source as by `read_dataclass`."""
    found = {}
    for item in _source_of(module, name).body:
        if isinstance(item, ast.AnnAssign) and item.value is not None:
            with contextlib.suppress(ValueError):  # a computed default
                found[ast.unparse(item.target)] = ast.literal_eval(item.value)
    return found


def _source_of(module: str, name: str) -> ast.ClassDef:
    path = Path(gmmtorch.__file__).parent.joinpath(*module.split(".")).with_suffix(".py")
    tree = ast.parse(path.read_text(encoding="utf-8"))
    (source,) = (node for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    return source


def _accepted(hint: Any) -> Any:
    """The type that OmegaConf accepts in place of a type."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return str
    if origin in (Union, UnionType):
        if any(is_dataclass(one) for one in arguments):
            return Any
        return functools.reduce(operator.or_, map(_accepted, arguments))
    if origin in (tuple, Sequence):
        return list[_accepted(arguments[0])]  # type: ignore[misc]  # a type that is known at run time only
    return hint


def _default(item: Field[Any]) -> Any:
    if item.default_factory is not MISSING:
        return field(default_factory=item.default_factory)
    if item.default is MISSING:
        return field(default="???")
    value = item.default
    return field(default_factory=lambda: list(value)) if isinstance(value, tuple) else field(default=value)


def build(cls: type[T], options: Mapping[str, Any], group: str, **others: Any) -> T:
    """An object of a dataclass from the options of a group; options that are not its fields are ignored.

    Args:
        options: values by name, for example of `common.as_options`.
        group: name of the group; errors name an option as `group.option`.
        others: further arguments, which replace options.

    Raises `InvalidArgumentError` for a value that the class refuses, or with a wrong type or length.
    """
    hints = get_type_hints(cls)
    names = [item.name for item in fields(cls) if item.name in options and item.name not in others]  # type: ignore[arg-type]
    arguments = {name: _converted(hints[name], options[name], f"{group}.{name}") for name in names}
    with common.naming({name: f"{group}.{name}" for name in names}):
        return cls(**arguments, **others)


def _converted(hint: Any, value: Any, name: str) -> Any:
    """A value of a configuration as the type that a dataclass declares."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and value is not None:
        return next((_nested(one, value, name) for one in arguments if is_dataclass(one)), value)
    if origin is tuple and Ellipsis not in arguments and len(value) != len(arguments):
        raise InvalidArgumentError(f"{name}={list(value)} must have {len(arguments)} entries.")
    return tuple(value) if origin in (tuple, Sequence) else value


def _nested(cls: Any, options: Any, name: str) -> Any:
    """An object of an optional dataclass, whose options Hydra has not checked."""
    checked = OmegaConf.structured(schema_of(cls))
    try:
        if not isinstance(options, dict):
            raise TypeError("not a group of options")
        checked.merge_with(options)
    except (OmegaConfBaseException, TypeError) as error:
        raise InvalidArgumentError(
            f"{name}={options}: {str(error).splitlines()[0]}; give null, or options from "
            f"{{{', '.join(item.name for item in fields(cls))}}}."
        ) from error
    plain: Any = OmegaConf.to_container(checked)
    return build(cls, plain, name)
