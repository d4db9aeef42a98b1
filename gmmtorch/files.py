"""Atomic writing of files, and tensor files whose content is checked when they are read."""

from __future__ import annotations

import contextlib
import io
import json
import os
import secrets
import stat
import sys
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, BinaryIO

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
_MOST_DIMS = 8
_TENSOR = "$tensor"
_NO_CHECKSUM = "00000000"  # stands for the checksum while it is computed
_BEFORE_CHECKSUM = rb'"{\"crc32\":\"'  # the first bytes of our entry in the header


def write_atomically(path: str | Path, write: Callable[[Path], object]) -> Path:
    """Call `write` with a temporary file in the folder of `path`, then rename that file to `path`.

    On any failure the temporary file is removed and `path` stays as it was. The temporary file has the
    suffix of `path`, because some writers choose their format by it. If `path` is a symbolic link, the file
    it points to is replaced and the link stays. A replaced file keeps its mode; a new file has the mode of
    the umask.

    Raises `OutputError` if the folder cannot be written to, the disk is full, or `path` is a folder, a
    device, a FIFO or a socket.
    """
    path = Path(path)
    try:
        target, mode = _target(path)
    except OSError as error:
        raise _unwritable(path, error, "choose another path") from error
    # The name is known before the file exists, so that an interrupt at any time leaves no file behind.
    temporary = target.with_name(f".{target.stem[:100]}.{secrets.token_hex(8)}{target.suffix}")
    try:
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            flags = os.O_CREAT | os.O_EXCL | os.O_WRONLY
            os.close(os.open(temporary, flags, 0o666 if mode is None else 0o600))
        except OSError as error:
            raise _unwritable(path, error, "choose another path") from error
        try:
            write(temporary)
            if mode is not None:
                temporary.chmod(mode)
            temporary.replace(target)
        except OSError as error:
            raise _unwritable(path, error, "no file was changed") from error
    except BaseException:  # includes KeyboardInterrupt
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    return path


def _unwritable(path: Path, error: OSError, remedy: str) -> OutputError:
    return OutputError(f"{path} cannot be written: {error.strerror or error}; {remedy}.")


def _target(path: Path) -> tuple[Path, int | None]:
    """The file that `path` names, links followed, and its mode; None if it does not exist.

    Raises `OSError` for a loop of links, and for what is not a regular file.
    """
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return Path(os.path.realpath(path)), None
    if not stat.S_ISREG(mode):
        kinds = ((stat.S_ISDIR, "folder"), (stat.S_ISFIFO, "FIFO"), (stat.S_ISSOCK, "socket"))
        kind = next((name for is_kind, name in kinds if is_kind(mode)), "device")
        raise OSError(f"it is a {kind}, not a regular file")
    return Path(os.path.realpath(path)), stat.S_IMODE(mode)


def check_writable(folder: Path) -> None:
    """Create the folder, and raise `OutputError` if files cannot be written in it."""
    probe = write_atomically(folder / ".probe", lambda temporary: None)
    probe.unlink()


def write_bytes(path: str | Path, data: bytes) -> Path:
    """Write bytes atomically."""
    return write_atomically(path, lambda temporary: temporary.write_bytes(data))


class FileLock:
    """A lock that one object at a time holds, in all processes of a machine.

    The system frees it when the object or its process ends, in whatever way. The file stays.

    Args:
        path: of an empty file, which is made.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: BinaryIO | None = None

    def hold(self) -> bool:
        """Takes the lock. False if this object had it; raises `OutputError` if another one has it."""
        if self._file is not None:
            return False
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            with contextlib.ExitStack() as stack:
                file = stack.enter_context(self._path.open("ab"))
                _lock(file)
                stack.pop_all()
        except BlockingIOError as error:
            raise OutputError(
                f"{self._path.parent} is being written by another program, or by another object of this one; "
                "wait until it is finished, or choose another folder."
            ) from error
        except OSError as error:
            raise _unwritable(self._path, error, "choose another folder") from error
        self._file = file
        return True

    def release(self) -> None:
        """Frees the lock."""
        if self._file is not None:
            self._file.close()
            self._file = None


def _lock(file: BinaryIO) -> None:
    """Locks a file until it is closed. Raises `BlockingIOError` if it is locked."""
    if sys.platform == "win32":
        import msvcrt

        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError as error:
            raise BlockingIOError(*error.args) from error
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


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
    """Bytes of a safetensors file whose header states its kind, version, `facts` (JSON values) and CRC-32."""
    # A single entry keeps the bytes reproducible: the order of several entries varies between runs.
    entry = {"crc32": _NO_CHECKSUM, "format": kind, "version": version, "facts": facts}
    header = json.dumps(entry, sort_keys=True, separators=(",", ":"))
    contiguous = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    return with_checksum(safetensors_save(contiguous, {"gmmtorch": header}))


def with_checksum(data: bytes) -> bytes:
    """The bytes of a tensor file with its CRC-32 in the header, in place of the present one."""
    place = _checksum_place(data)
    return b"".join((data[:place], _checksum(data, place).encode(), data[place + len(_NO_CHECKSUM) :]))


def _checksum_place(data: bytes) -> int:
    """Where the header states the CRC-32. Raises `ValueError` if it does not."""
    # The entry of the metadata is the first of the header, so the first match is the right one.
    return data.index(_BEFORE_CHECKSUM) + len(_BEFORE_CHECKSUM)


def _checksum(data: bytes, place: int) -> str:
    """CRC-32 of all bytes, with zeros where the header states the CRC-32; eight hexadecimal digits."""
    before = zlib.crc32(_NO_CHECKSUM.encode(), zlib.crc32(memoryview(data)[:place]))
    return f"{zlib.crc32(memoryview(data)[place + len(_NO_CHECKSUM) :], before):08x}"


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
    _check_checksum(data, path, header.get("crc32"))
    facts = header.get("facts")
    if not isinstance(facts, dict):
        raise DataError(f"{path}: facts is not a table; the file is damaged.")
    try:
        tensors = safetensors_load(data)
        if any(tensor.ndim > _MOST_DIMS for tensor in tensors.values()):
            raise ValueError(f"a tensor has more than {_MOST_DIMS} dimensions")
        return tensors, facts
    except (SafetensorError, KeyError, TypeError, ValueError, RuntimeError) as error:
        raise DataError(f"{path} is damaged: {error}") from error


def _check_checksum(data: bytes, path: str | Path, stated: object) -> None:
    try:
        found = _checksum(data, _checksum_place(data))
    except ValueError as error:
        raise DataError(f"{path} has no checksum, or a damaged one; write the file again.") from error
    if found != stated:
        raise DataError(
            f"{path} is damaged: its CRC-32 is {found}, but its header states {stated!r}. Copy the file "
            "again from where it was written."
        )


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

    def replaced(part: Any) -> Any:
        if isinstance(part, Tensor):
            name = str(len(tensors))
            tensors[name] = part.detach().cpu().contiguous().clone()
            return {_TENSOR: name}
        if isinstance(part, dict):
            return {str(key): replaced(item) for key, item in part.items()}
        return [replaced(item) for item in part] if isinstance(part, list | tuple) else part

    return replaced(value), tensors


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
