"""Atomic writing of files, and tensor files whose content is checked when they are read."""

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
    """Call `write` with a temporary file in the folder of `path`, then rename that file to `path`.

    On any failure the temporary file is removed and `path` stays as it was. The temporary file has the
    suffix of `path`, because some writers choose their format by it. Raises `OutputError` if the folder
    cannot be written to or the disk is full.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=f".{path.stem}.", suffix=path.suffix, dir=path.parent)
    except OSError as error:
        raise OutputError(f"{path} cannot be written: {error.strerror}; choose another folder.") from error
    os.close(handle)
    temporary = Path(name)
    try:
        write(temporary)
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise OutputError(
            f"{path} cannot be written: {error.strerror or error}; no file was changed."
        ) from error
    except BaseException:  # includes KeyboardInterrupt
        temporary.unlink(missing_ok=True)
        raise
    return path


def check_writable(folder: Path) -> None:
    """Create the folder, and raise `OutputError` if files cannot be written in it."""
    probe = write_atomically(folder / ".probe", lambda temporary: None)
    probe.unlink()


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write bytes atomically."""

    def write(temporary: Path) -> None:
        temporary.write_bytes(data)

    return write_atomically(path, write)


def write_npz(path: str | Path, **arrays: NDArray[Any]) -> Path:
    """Write named arrays as one compressed npz file, atomically."""
    packed = io.BytesIO()
    np.savez_compressed(packed, **arrays)  # type: ignore[arg-type]
    return write_bytes(path, packed.getvalue())


def write_json(path: str | Path, value: Any) -> Path:
    """Write JSON atomically. Raises `ValueError` for NaN and infinity, which JSON does not have."""
    text = json.dumps(value, indent=2, allow_nan=False) + "\n"
    return write_bytes(path, text.encode())


def pack_tensors(tensors: Mapping[str, Tensor], kind: str, version: int, **facts: Any) -> bytes:
    """Bytes of a safetensors file whose header states its kind, version and `facts` (JSON values)."""
    # A single entry keeps the bytes reproducible: the order of several entries varies between runs.
    header = json.dumps({"format": kind, "version": version, "facts": facts}, sort_keys=True)
    return safetensors_save(
        {k: v.detach().cpu().contiguous() for k, v in tensors.items()}, {"gmmtorch": header}
    )


def read_tensors(path: str | Path, kind: str, *versions: int) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of a file that `pack_tensors` wrote in one of these versions.

    Raises `MissingDataError` if the file does not exist, and `DataError` if it is too large, damaged, of
    another kind, or of another version.
    """
    path = Path(path)
    if not path.is_file():
        raise MissingDataError(f"{path} does not exist; expected a {kind} file.")
    size = path.stat().st_size
    if size > MAX_FILE_BYTES:
        raise DataError(f"{path} has {size:,} bytes, more than the limit of {MAX_FILE_BYTES:,}.")
    return unpack_tensors(path.read_bytes(), path, kind, *versions)


def unpack_tensors(
    data: bytes, path: str | Path, kind: str, *versions: int
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Tensors and facts of bytes that `pack_tensors` wrote. `path` is named in errors. Raises `DataError`."""
    header = _read_header(data, path, kind)
    if header.get("format") != kind:
        raise DataError(f"{path} is a file of {header.get('format', 'another kind')!r}; expected {kind!r}.")
    if header.get("version") not in versions:
        raise DataError(
            f"{path} is version {header.get('version')!r} of {kind}; this gmmtorch reads version "
            f"{' or '.join(map(str, versions))}. Update gmmtorch, or write the file again."
        )
    facts = header.get("facts")
    if not isinstance(facts, dict):
        raise DataError(f"{path}: facts is not a table; the file is damaged.")
    try:
        return safetensors_load(data), facts
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"{path} is damaged: {error}") from error


def _read_header(data: bytes, path: str | Path, kind: str) -> dict[str, Any]:
    """The header that `pack_tensors` wrote: kind, version and facts."""
    try:
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > len(data) - 8:
            raise ValueError("its header is longer than the file")
        header = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["gmmtorch"])
        if not isinstance(header, dict):
            raise ValueError("its header is not a table")
        return header
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DataError(
            f"{path} is truncated or not a gmmtorch file ({error!r}); expected {kind!r}."
        ) from error


def split_tensors(value: Any) -> tuple[Any, dict[str, Tensor]]:
    """A nested structure with each tensor replaced by a name, and the tensors by name.

    `value` is made of dicts, lists, tuples and JSON values. `joined_tensors` is the inverse.
    """
    tensors: dict[str, Tensor] = {}
    return _replace_tensors(value, tensors), tensors


def _replace_tensors(value: Any, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, Tensor):
        name = str(len(tensors))
        tensors[name] = value.detach().cpu().contiguous().clone()
        return {_TENSOR: name}
    if isinstance(value, dict):
        return {str(key): _replace_tensors(item, tensors) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_tensors(item, tensors) for item in value]
    return value


def joined_tensors(tree: Any, tensors: Mapping[str, Tensor]) -> Any:
    """The inverse of `split_tensors`. Raises `KeyError` or `TypeError` if a tensor is missing."""
    if isinstance(tree, dict):
        if set(tree) == {_TENSOR}:
            return tensors[tree[_TENSOR]]
        return {key: joined_tensors(item, tensors) for key, item in tree.items()}
    if isinstance(tree, list):
        return [joined_tensors(item, tensors) for item in tree]
    return tree


def narrowest(values: Tensor) -> Tensor:
    """Whole numbers ≥ 0 in the narrowest of uint8, int16, int32 and int64 that can represent all of them."""
    largest = int(values.max()) if values.numel() else 0
    return values.to(next(dtype for dtype in NARROW_DTYPES if largest <= torch.iinfo(dtype).max))


def require(
    tensors: Mapping[str, Tensor],
    name: str,
    shape: tuple[int | None, ...],
    dtype: torch.dtype,
    path: str | Path,
) -> Tensor:
    """Returns the tensor `name`.

    Raises `DataError` unless it is finite and has this shape (None: any size) and dtype.
    """
    tensor = tensors.get(name)
    if tensor is None:
        raise DataError(f"{path} lacks the tensor {name!r}.")
    fits = tensor.ndim == len(shape) and all(w in (None, n) for w, n in zip(shape, tensor.shape, strict=True))
    if not fits or tensor.dtype != dtype:
        raise DataError(
            f"{path}: {name} is {tensor.dtype} {tuple(tensor.shape)}; expected {dtype} {shape} "
            "(None: any size)."
        )
    if tensor.is_floating_point() and not bool(torch.isfinite(tensor).all()):
        raise DataError(f"{path}: {name} has NaN or infinite values; the file is damaged.")
    return tensor


def require_counts(
    tensors: Mapping[str, Tensor], name: str, shape: tuple[int | None, ...], path: str | Path
) -> Tensor:
    """Returns the tensor `name`, whole numbers ≥ 0 in a type that `narrowest` chooses, as int64.

    Raises `DataError`.
    """
    stored = tensors.get(name)
    dtype = stored.dtype if stored is not None and stored.dtype in NARROW_DTYPES else torch.uint8
    counts = require(tensors, name, shape, dtype, path).long()
    if counts.numel() and int(counts.min()) < 0:
        raise DataError(f"{path}: {name} has negative numbers; the file is damaged.")
    return counts
