"""Nested states as one file: tensors as safetensors, the rest as JSON; no pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError
from gmmtorch.files import joined_tensors, pack_tensors, read_tensors, split_tensors, write_bytes

_KIND, _VERSION = "mission", 1


def save_checkpoint(path: str | Path, state: dict[str, Any], **facts: Any) -> Path:
    """Write a nested state of dicts, lists, numbers, text, None and tensors, atomically.

    `facts` are plain values that say what the state is of; `load_checkpoint` compares them.
    """
    tree, tensors = split_tensors(state)
    return write_bytes(path, pack_tensors(tensors, _KIND, _VERSION, tree=tree, facts=facts))


def load_checkpoint(path: str | Path, **facts: Any) -> dict[str, Any]:
    """The state that `save_checkpoint` wrote. Raises `DataError` if it is of something else, or damaged."""
    tensors, about = read_tensors(path, _KIND, _VERSION)
    try:
        kept, tree = about["facts"], about["tree"]
        different = [
            f"{key}={kept.get(key)} there, {facts.get(key)} here"
            for key in sorted({*facts, *kept})
            if facts.get(key) != kept.get(key)
        ]
        if different:
            raise DataError(
                f"{path} is the checkpoint of another mission ({'; '.join(different)}); give what it was "
                "started with, or another checkpoint.folder."
            )
        state: dict[str, Any] = joined_tensors(tree, tensors)
    except (KeyError, TypeError, AttributeError) as error:
        raise DataError(f"{path}: the checkpoint is damaged ({error!r}); start anew.") from error
    return state
