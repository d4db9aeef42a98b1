"""Files that are never half-written, and tensor files that are checked before they are believed."""

from __future__ import annotations

import io
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load as safetensors_load
from safetensors.torch import save as safetensors_save
from torch import Tensor

from gmmtorch.errors import DataError, MissingDataError, OutputError

MAX_FILE_BYTES = 8 << 30
NARROW_DTYPES = (torch.uint8, torch.int16, torch.int32, torch.int64)
_TENSOR = "$tensor"


def write_atomically(path: str | Path, write: Callable[[Path], None]) -> Path:
    """Let `write` fill a temporary file beside `path`, then rename it; on any failure nothing is left.

    The temporary file has the same suffix as `path`, as some writers go by it. Raises `OutputError`
    when the place cannot be written to, or the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}; choose another place.") from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(f"{path} cannot be written: {error.strerror or error}; nothing was.") from error
    except BaseException:  # Ctrl-C must not leave a fragment either
        temporary.unlink(missing_ok=True)
        raise
    return path


def check_writable(folder: Path) -> None:
    """Make the folder, and raise `OutputError` if files cannot be written there."""
    probe = write_atomically(folder / ".probe", lambda temporary: None)
    probe.unlink()


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write bytes atomically."""
    return write_atomically(path, lambda temporary: _write_all(temporary, data))


def _write_all(path: Path, data: bytes) -> None:
    path.write_bytes(data)


def write_npz(path: str | Path, **arrays: NDArray[Any]) -> Path:
    """Write named arrays as one compressed npz file, atomically."""
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)  # type: ignore[arg-type]
    return write_bytes(path, packed.getvalue())


def write_json(path: str | Path, value: Any) -> Path:
    """Write JSON atomically; NaN and infinity are refused, as JSON has neither."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    return write_bytes(path, text.encode())


def pack_tensors(tensors: Mapping[str, Tensor], kind: str, version: int, **facts: Any) -> bytes:
    """A safetensors file that says what it holds. `facts` must be JSON."""
    # One entry: with several, their order, and so the file's bytes, would change from run to run.
    about = json.dumps({"format": kind, "version": version, "facts": facts}, sort_keys=True)
    return safetensors_save(
        {k: v.detach().cpu().contiguous() for k, v in tensors.items()}, {"gmmtorch": about}
    )


def read_tensors(path: str | Path, kind: str, *versions: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of a file of `pack_tensors`, of any of these versions.

    Raises `MissingDataError` when it is not there, and `DataError` when it is too large, damaged,
    of another kind, or of a later version.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected a {kind} file.")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise DataError(f"{path} has {size:,} bytes, more than the {MAX_FILE_BYTES:,} that are read.")
    return unpack_tensors(path.read_bytes(), path, kind, *versions)


def unpack_tensors(
    data: bytes, path: str | Path, kind: str, *versions: int
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of what `pack_tensors` wrote; `path` is where it was found. Raises `DataError`."""
    about = _about(data, path, kind)
    if about.get("format") != kind:
        raise DataError(f"{path} holds {about.get('format', 'something else')!r}; expected {kind!r}.")
    if about.get("version") not in versions:
        raise DataError(
            f"{path} is version {about.get('version')!r} of {kind}; this gmmtorch reads version "
            f"{' or '.join(map(str, versions))}. "
            "Update gmmtorch, or write the file again."
        )
    facts = about.get("facts")
    if not isinstance(facts, dict):
        raise DataError(f"{path}: its facts are no table; the file is damaged.")
    try:
        return safetensors_load(data), facts
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"{path} is damaged: {error}") from error


def _about(data: bytes, path: str | Path, kind: str) -> dict[str, Any]:
    """What `pack_tensors` wrote into the header of a safetensors file."""
    try:
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > len(data) - 8:
            raise ValueError("its header is longer than the file")
        about = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["gmmtorch"])
        if not isinstance(about, dict):
            raise ValueError("its header is not a table")
        return about
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path} is truncated, or not a file of gmmtorch ({error!r}); expected {kind!r}."
        ) from error


def split_tensors(value: Any) -> tuple[Any, dict[str, Tensor]]:
    """A nest of dicts, lists and plain values, with names in the places of its tensors; and the tensors."""
    tensors: dict[str, Tensor] = {}
    return _stripped(value, tensors), tensors


def _stripped(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {_TENSOR: name}
    if isinstance(value, dict):
        return {str(key): _stripped(item, tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_stripped(item, tensors) for item in value]
    return value


def joined_tensors(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The inverse of `split_tensors`. Raises `KeyError` or `TypeError` for a tensor that is not there."""
    if isinstance(tree, dict):
        if set(tree) == {_TENSOR}:
            return tensors[tree[_TENSOR]]
        return {key: joined_tensors(item, tensors) for key, item in tree.items()}
    if isinstance(tree, list):
        return [joined_tensors(item, tensors) for item in tree]
    return tree


def narrowest(values: Tensor) -> Tensor:
    """Whole numbers ≥ 0 in the narrowest of uint8, int16, int32 and int64 that holds them all."""
    largest = int(values.max()) if values.numel() else 0
    return values.to(next(dtype for dtype in NARROW_DTYPES if largest <= torch.iinfo(dtype).max))


def require(
    tensors: Mapping[str, Tensor],
    name: str,
    shape: tuple[int | None, ...],
    dtype: torch.dtype,
    path: str | Path,
) -> Tensor:
    """The tensor `name`, if it has this shape (None: any size) and dtype and is finite; else `DataError`."""
    tensor = tensors.get(name)
    if tensor is None:
        raise DataError(f"{path} lacks the tensor {name!r}.")
    fits = tensor.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, tensor.shape, strict=True))
    if not fits or tensor.dtype != dtype:
        raise DataError(
            f"{path}: {name} is {tensor.dtype} {tuple(tensor.shape)}; expected {dtype} "
            f"{shape}, None for any size."
        )
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        raise DataError(f"{path}: {name} holds NaN or infinite values; the file is damaged.")
    return tensor


def require_counts(
    tensors: Mapping[str, Tensor], name: str, shape: tuple[int | None, ...], path: str | Path
) -> Tensor:
    """The tensor `name`, whole numbers ≥ 0 in whichever type `narrowest` chose, as int64."""
    stored = tensors.get(name)
    dtype = stored.dtype if stored is not None and stored.dtype in NARROW_DTYPES else torch.uint8
    counts = require(tensors, name, shape, dtype, path).long()
    if counts.numel() and int(counts.min()) < 0:
        raise DataError(f"{path}: {name} holds negative numbers; the file is damaged.")
    return counts
