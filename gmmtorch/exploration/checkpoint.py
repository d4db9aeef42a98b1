"""Nested states as one file: tensors as safetensors, the rest as JSON; no pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.files import pack_tensors, read_tensors, write_bytes

_KIND, _VERSION = "mission", 1
_TENSOR = "$tensor"


def save_checkpoint(path: str | Path, state: dict[str, Any], **facts: Any) -> Path:
    """Write a nested state of dicts, lists, numbers, text, None and tensors, atomically.

    `facts` are plain values that say what the state is of; `load_checkpoint` compares them.
    """
    tensors: dict[str, Tensor] = {}
    tree = _stripped(state, tensors)
    return write_bytes(path, pack_tensors(tensors, _KIND, _VERSION, tree=tree, facts=facts))


def load_checkpoint(path: str | Path, **facts: Any) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote. Raises `DataError` if it is of something else, or damaged."""
    tensors, about = read_tensors(path, _KIND, _VERSION)
    try:
        kept, tree = about["facts"], about["tree"]
        different = sorted(key for key in {*facts, *kept} if facts.get(key) != kept.get(key))
        if different:
            raise DataError(
                f"{path} is the checkpoint of another mission ({', '.join(different)} differ); give the "
                "options it was started with, or another folder."
            )
        state: dict[str, Any] = _restored(tree, tensors)
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: the checkpoint is damaged ({error!r}); start anew.") from error
    return state


def _stripped(value: Any, tensors: dict[str, Tensor]) -> Any:
    """A value with its tensors moved to `tensors`, and their names in their places."""
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {_TENSOR: name}
    if isinstance(value, dict):
        return {str(key): _stripped(item, tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_stripped(item, tensors) for item in value]
    return value


def _restored(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, dict):
        if set(value) == {_TENSOR}:
            return tensors[value[_TENSOR]]
        return {key: _restored(item, tensors) for key, item in value.items()}
    if isinstance(value, list):
        return [_restored(item, tensors) for item in value]
    return value
