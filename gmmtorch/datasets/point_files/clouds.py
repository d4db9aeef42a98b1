"""Reading point cloud files with Open3D, imported only when a file is read."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError

_HEADER_BYTES = 1 << 16
_PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


class _Announced(NamedTuple):
    """What a header promises: points, and the words (text) or bytes (binary) of data that follow it."""

    points: int
    is_text: bool
    length: int
    header_bytes: int


def open3d_for(path: Path) -> Any:
    """Open3D, to read this file; raises `GmmTorchError` where it does not load."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise GmmTorchError(
            f"{path} cannot be read, because Open3D does not load: {error}. On Debian or Ubuntu install "
            "libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libgomp1 (scripts/setup.sh does it)."
        ) from error
    return open3d


def read_cloud(path: Path) -> Tensor:
    """Points (N, 3), float64, of a PCD or PLY file, NaN rows included.

    Raises `DataError` if the file is unreadable or shorter than its header says.
    """
    open3d = open3d_for(path)
    expected = _check_whole(path)
    try:
        with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error):
            cloud = open3d.t.io.read_point_cloud(path)
            points = cloud.point.positions.numpy() if "positions" in cloud.point else np.empty((0, 3))
    except (RuntimeError, KeyError) as error:
        raise DataError(f"{path} cannot be read as a point cloud: {error}") from error
    if points.shape[0] != expected:
        raise DataError(
            f"{path} announces {expected} points, but {points.shape[0]} could be read; the file is "
            "truncated or not a point cloud. Write it again."
        )
    return torch.from_numpy(points.astype(np.float64))


def pcd_header(path: Path) -> dict[str, list[str]]:
    """Header fields of a PCD file, such as {"VIEWPOINT": ["0", "0", "0", "1", "0", "0", "0"]}."""
    fields: dict[str, list[str]] = {}
    for line in file_head(path).split(b"\n"):
        words = line.decode("ascii", errors="replace").split()
        if words and not words[0].startswith("#"):
            fields[words[0]] = words[1:]
            if words[0] == "DATA":
                return fields
    raise DataError(f"{path} has no PCD header (no DATA line); it is not a PCD file.")


def _check_whole(path: Path) -> int:
    """How many points the file holds, after checking that it is as long as its header says.

    Open3D fills up with zeros what a truncated file lacks, and so would not notice.
    """
    try:
        announced = _pcd_announced(path) if path.suffix == ".pcd" else _ply_announced(path)
    except (ValueError, KeyError, IndexError) as error:
        if isinstance(error, DataError):
            raise
        raise DataError(f"{path} has a damaged header ({error!r}); write it again.") from error
    if announced.is_text:
        with path.open("rb") as file:
            file.seek(announced.header_bytes)
            held = len(file.read().split())
    else:
        held = path.stat().st_size - announced.header_bytes
    if held < announced.length:
        unit = "numbers" if announced.is_text else "bytes"
        raise DataError(
            f"{path} announces {announced.points} points, but ends after {held} of {announced.length} "
            f"{unit}; it is truncated. Write or fetch it again."
        )
    return announced.points


def _pcd_announced(path: Path) -> _Announced:
    header = pcd_header(path)
    if not header.get("POINTS", [""])[0].isdecimal():
        raise DataError(f"{path} does not say how many points it holds (POINTS); it is damaged.")
    points, kind = int(header["POINTS"][0]), header["DATA"][0]
    counts = [int(c) for c in header.get("COUNT", ["1"] * len(header["FIELDS"]))]
    width = sum(counts)
    if kind != "ascii":
        width = sum(c * int(s) for c, s in zip(counts, header["SIZE"], strict=True))
    # a compressed file starts with its own length, which Open3D does check
    length = 0 if kind == "binary_compressed" else points * width
    return _Announced(points, kind == "ascii", length, header_end(path, b"DATA"))


def _ply_announced(path: Path) -> _Announced:
    """A list is counted with its length alone, since how long it is stands in the data."""
    lines = [line.decode("ascii", errors="replace").split() for line in file_head(path).split(b"\n")]
    if lines[0] != ["ply"]:
        raise DataError(f"{path} does not start with 'ply'; it is not a PLY file.")
    is_text, points, length, count = True, None, 0, 0
    for words in lines[: lines.index(["end_header"])]:
        if words[:1] == ["format"]:
            is_text = words[1] == "ascii"
        elif words[:1] == ["element"]:
            count = int(words[2])
            points = count if words[1] == "vertex" else points
        elif words[:1] == ["property"]:
            length += count * (1 if is_text else _PLY_BYTES[words[2] if words[1] == "list" else words[1]])
    if points is None:
        raise DataError(f"{path} does not say how many points it holds (element vertex); it is damaged.")
    return _Announced(points, is_text, length, header_end(path, b"end_header"))


def file_head(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(_HEADER_BYTES)


def header_end(path: Path, last_line: bytes) -> int:
    """Position of the first byte after the line that begins with `last_line`."""
    head = file_head(path)
    return head.index(b"\n", head.index(b"\n" + last_line) + 1) + 1
