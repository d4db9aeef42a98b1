"""Hydra's schemas, made from dataclasses with options; and objects of these classes from a configuration."""

from __future__ import annotations

import functools
import operator
import sys
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, Field, dataclass, field, fields, is_dataclass, make_dataclass
from types import UnionType
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.datasets import OPTIONS
from gmmtorch.declarations import About, declared, default_of, option
from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.mapping import IncrementalRule, QueryOptions, WindowedRule

T = TypeVar("T")
Tree = dict[str, Any]
"""Fields of `make_dataclass` by name, and trees for groups."""
_ABOUT, _PYTHON = "about", "python"


def schema_of(*sources: type | tuple[str, type], without: Collection[str] = (), **choices: str) -> Any:
    """A dataclass that OmegaConf accepts as a schema, with the options of these dataclasses.

    OmegaConf supports neither frozen dataclasses nor `Literal`, tuples or optional dataclasses. They become
    plain dataclasses, str, lists and `Any`; `build` checks their values.

    Args:
        sources: dataclasses; a later one replaces options of an earlier one. With a name: of a group.
        without: dotted names that are left out; of a group, with all that it has.
        choices: fixed values, such as name="point".
    """
    tree: Tree = {}
    for source in sources:
        prefix, cls = source if isinstance(source, tuple) else ("", source)
        _add(tree, cls, prefix)
    for name in without:
        _remove(tree, name.split("."))
    for name, value in choices.items():
        tree[name] = (name, str, field(default=value))
    return _made("Options", tree)


def part_of(cls: type, name: str, without: Collection[str] = ()) -> Any:
    """The schema of the group `name` of a dataclass, which has a choice of its own."""
    tree: Tree = {}
    _add(tree, cls, "")
    for one in without:
        _remove(tree[name], one.split("."))
    return _made("Options", tree[name])


def _add(tree: Tree, cls: type, prefix: str, defaults: Mapping[str, Any] | None = None) -> None:
    hints = _hints(cls)
    for item, about in declared(cls):
        name = item.name if about.name is None else about.name
        place = f"{prefix}.{name}".strip(".") if prefix else name
        if about.options is not None:
            _add(tree, about.options, place, about.defaults)
            continue
        node, (*path, last) = tree, place.split(".")
        for part in path:
            node = node.setdefault(part, {})
        changed = (defaults or {}).get(item.name, MISSING)
        node[last] = (last, _accepted(hints[item.name]), _field(item, about, changed))


def _remove(tree: Tree, path: list[str]) -> None:
    node = tree
    for part in path[:-1]:
        node = node[part]
    del node[path[-1]]


def _made(title: str, tree: Tree) -> Any:
    parts = []
    for name, found in tree.items():
        if isinstance(found, dict):
            made = _made(name, found)
            found = (name, made, field(default_factory=made))
        parts.append(found)
    return make_dataclass(title, parts)


def _hints(cls: type) -> dict[str, Any]:
    """The types of the options. Types of other fields may need modules that load torch."""
    found: dict[str, Any] = {}
    known = {item.name for item, about in declared(cls) if about.options is None}
    for base in reversed(cls.__mro__):
        own = {name: hint for name, hint in vars(base).get("__annotations__", {}).items() if name in known}
        scope = vars(sys.modules[base.__module__])
        found |= get_type_hints(type(base.__name__, (), {"__annotations__": own}), scope)
    return found


def _accepted(hint: Any) -> Any:
    """The type that OmegaConf accepts in place of a type."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return str
    if origin in (Union, UnionType):
        if any(is_dataclass(one) or get_origin(one) is tuple for one in arguments):
            return Any
        return functools.reduce(operator.or_, map(_accepted, arguments))
    if origin in (tuple, Sequence):
        inner = _accepted(arguments[0])
        is_plain = inner in (int, float, str, bool) or inner is Any
        return list[inner] if is_plain else list[Any]  # type: ignore[valid-type]
    return hint


def _field(item: Field[Any], about: About, changed: Any) -> Any:
    kept = {_ABOUT: about.text, _PYTHON: item.name}
    value = default_of(item) if changed is MISSING else changed
    if isinstance(value, tuple | list | dict):
        plain = list(value) if isinstance(value, tuple) else value
        return field(default_factory=plain.copy, metadata=kept)
    return field(default=value, metadata=kept)


def about_of(node: DictConfig, name: str) -> str:
    """The sentence of an option of a node; "" if it has none."""
    return str(_metadata(node, name).get(_ABOUT, ""))


def _metadata(node: DictConfig, name: str) -> Mapping[str, Any]:
    made = OmegaConf.get_type(node)
    found = made.__dataclass_fields__.get(name) if is_dataclass(made) else None
    return {} if found is None else found.metadata


def option_names(config: DictConfig, prefix: str = "") -> dict[str, str]:
    """The options of a composed configuration, or of a part of it, by the arguments that they become.

    An argument that several options become is left out, unless one of them is at the top.
    """
    found: dict[str, set[str]] = {}
    for python, name in _names(config, prefix):
        found.setdefault(python, set()).add(name)
    return {
        python: min(names, key=len)
        for python, names in found.items()
        if len(names) == 1 or f"{prefix}{python}" in names
    }


def _names(node: DictConfig, prefix: str) -> Iterator[tuple[str, str]]:
    for key in map(str, node):
        value = None if OmegaConf.is_missing(node, key) else node._get_node(key)
        if key == "hydra" and not prefix:
            continue
        if isinstance(value, DictConfig) and not value._is_none():
            yield from _names(value, f"{prefix}{key}.")
        yield str(_metadata(node, key).get(_PYTHON, key)), f"{prefix}{key}"


def build(cls: type[T], config: Any, prefix: str = "", **others: Any) -> T:
    """An object of a dataclass from the options of a configuration, or of a group of it.

    Args:
        config: the whole configuration.
        prefix: name of the group; errors name an option with it.
        others: further arguments, which replace options.

    Raises `InvalidArgumentError` for a value that the class refuses, or with a wrong type or length.
    """
    hints = _hints(cls)
    arguments: dict[str, Any] = {}
    for item, about in declared(cls):
        name = item.name if about.name is None else about.name
        place = f"{prefix}.{name}".strip(".") if prefix else name
        if item.name in others:
            continue
        if about.options is not None:
            made = type(default_of(item))
            arguments[item.name] = build(made, config, place, **_of_python(made, about.defaults))
        elif (value := _selected(config, place)) is not MISSING:
            arguments[item.name] = _converted(hints[item.name], value, place)
    with naming(argument_names(cls, prefix)):
        return cls(**arguments, **others)


def argument_names(cls: Any, prefix: str = "") -> dict[str, str]:
    """The options of a dataclass by its fields; by `field.field` for those of a group."""
    found: dict[str, str] = {}
    for item, about in declared(cls):
        name = item.name if about.name is None else about.name
        place = f"{prefix}.{name}".strip(".") if prefix else name
        if about.options is None:
            found[item.name] = place
        else:
            inner = argument_names(about.options, place)
            found = {**inner, **{f"{item.name}.{one}": option for one, option in inner.items()}, **found}
    return found


def _of_python(cls: Any, defaults: Mapping[str, Any] | None) -> dict[str, Any]:
    """Those defaults that are no options."""
    options = {item.name for item, _ in declared(cls)}
    return {name: value for name, value in (defaults or {}).items() if name not in options}


def _selected(config: Any, place: str) -> Any:
    """The plain value of an option; `MISSING` if the configuration does not have it."""
    node = config if OmegaConf.is_config(config) else OmegaConf.create(config)
    value = OmegaConf.select(node, place, default=MISSING, throw_on_missing=False)
    path, _, last = place.rpartition(".")
    if value is None and OmegaConf.is_missing(OmegaConf.select(node, path) if path else node, last):
        return MISSING
    return OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value


@contextmanager
def naming(names: Mapping[str, str]) -> Iterator[None]:
    """Errors that are raised inside name the options that the user gave. names: the option of an argument."""
    try:
        yield
    except GmmTorchError as error:
        if (told := error.told(names)).args != error.args:
            raise told from error
        raise


def _converted(hint: Any, value: Any, name: str) -> Any:
    """A value of a configuration as the type that a dataclass declares."""
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType) and value is not None:
        for one in arguments:
            if is_dataclass(one):
                return _nested(one, value, name)
            if get_origin(one) is tuple:
                return tuple(value) if isinstance(value, list) else value
        return value
    if origin is tuple and Ellipsis not in arguments and len(value) != len(arguments):
        raise InvalidArgumentError(f"{name}={list(value)} must have {_COUNTS[len(arguments)]} entries.")
    return tuple(value) if origin in (tuple, Sequence) else value


_COUNTS = ("no", "one", "two", "three", "four")


def _nested(cls: Any, options: Any, name: str) -> Any:
    """An object of an optional dataclass from any of its fields, which Hydra has not checked."""
    hints = get_type_hints(cls)
    made = make_dataclass(
        cls.__name__,
        [(one.name, _accepted(hints[one.name]), _field(one, About(""), MISSING)) for one in fields(cls)],
    )
    checked = checked_options(made, options, name)
    with naming({one: f"{name}.{one}" for one in hints}):
        return cls(**checked)


def checked_options(schema: Any, options: Any, name: str) -> dict[str, Any]:
    """Options that Hydra has not checked, with the defaults of a schema. name: of their group."""
    found = OmegaConf.structured(schema)
    try:
        if not isinstance(options, dict):
            raise TypeError("not a group of options")
        found.merge_with(options)
    except (OmegaConfBaseException, TypeError) as error:
        raise InvalidArgumentError(
            f"{name}={options}: {str(error).splitlines()[0]}; give null, or options from "
            f"{{{', '.join(map(str, found))}}}."
        ) from error
    plain: Any = OmegaConf.to_container(found)
    return dict(plain)


@dataclass
class MapOptions:
    """Options of every map, beside those of its rule and of its queries."""

    name: str = option("???", "name of the choice")
    memory: float | None = option(
        None,
        "of gmmtorch-map: the map grows in tiles on disk, of which these bytes are open at most; null: in "
        "memory",
    )


def store(commands: Mapping[str, Any], groups: Mapping[str, Mapping[str, Any]] | None = None) -> None:
    """Stores schemas in Hydra's config store, under the names that the files in conf/ use.

    commands: the options of each command. groups: the options of each kind of a group.
    """
    hydra = ConfigStore.instance()
    for command, options in commands.items():
        hydra.store(name=f"{command}_schema", node=options)
    for group, kinds in (groups or {}).items():
        for kind, options in kinds.items():
            hydra.store(group=f"schema/{group}", name=kind, node=options)


def map_schema(name: str) -> Any:
    """The options of a map: incremental, windowed or per_scan."""
    rule = IncrementalRule if name == "incremental" else WindowedRule
    return schema_of(MapOptions, rule, QueryOptions)


@functools.cache  # the tests call it often
def register() -> None:
    """Stores the options of maps and data sets."""
    groups = {
        "map": {name: map_schema(name) for name in ("incremental", "windowed")},
        "dataset": {name: schema_of(cls) for name, cls in OPTIONS.items()},
    }
    store({}, groups)
