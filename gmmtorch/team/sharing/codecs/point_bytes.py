"""Cell numbering and byte packing of the point codecs."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping import BitReader, BitWriter, Ints
from gmmtorch.optional_packages import needs_extra

MOST_BITS = 21
"""Bits of a cell index along an axis; three axes fit into 63 bits."""
_LEVEL = 22  # the strongest of zstd
_LARGEST_OUTPUT = 1 << 26  # bytes that zstd may decompress to


# -- cells -------------------------------------------------------------------------------------------------


def checked_points(points: Tensor) -> NDArray[np.float64]:
    """Points (N, 3) as float64; raises `InvalidArgumentError` for another shape or values not finite."""
    rows = points.detach().double().cpu().numpy()
    if rows.ndim != 2 or rows.shape[1] != 3 or not np.isfinite(rows).all():
        raise InvalidArgumentError(f"points of shape {rows.shape} must be (N, 3), and finite.")
    return rows


def morton_codes(points: Tensor, resolution: float) -> tuple[Ints, Ints, int]:
    """Lowest cell (3,) of the points (N, 3), Morton codes (N,) of their cells from it, and bits per axis."""
    rows = checked_points(points) / resolution
    if not len(rows):
        return np.zeros(3, np.int64), np.zeros(0, np.int64), 0
    if not float(np.abs(rows).max()) < 2.0**52:
        raise InvalidArgumentError(f"points lie more than 2^52 cells of {resolution} m from the origin.")
    cells = np.floor(rows).astype(np.int64)
    corner = cells.min(0)
    cells -= corner
    depth = int(cells.max()).bit_length()
    if depth > MOST_BITS:
        raise InvalidArgumentError(
            f"points extend over {int(cells.max()) + 1} cells of {resolution} m; at most {1 << MOST_BITS} "
            "can be encoded. Use a coarser resolution, or encode fewer points at once."
        )
    spread = [_spread(cells[:, axis]) for axis in range(3)]
    return corner, spread[0] << 2 | spread[1] << 1 | spread[2], depth


_MASKS = [
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
]


def _spread(numbers: Ints) -> Ints:
    """Numbers below 2²¹ with two zeros inserted between their bits."""
    for shift, mask in _MASKS:
        numbers = (numbers | numbers << shift) & mask
    return numbers


def _gather(numbers: Ints) -> Ints:
    """The inverse of `_spread`; ignores the bits between."""
    numbers = numbers & _MASKS[-1][1]
    masks = [mask for _, mask in _MASKS[-2::-1]] + [(1 << MOST_BITS) - 1]
    for (shift, _), mask in zip(_MASKS[::-1], masks, strict=True):
        numbers = (numbers | numbers >> shift) & mask
    return numbers


def centers(corner: Ints, codes: Ints, resolution: float) -> Tensor:
    """Centres (N, 3) of the cells with these Morton codes (N,), metres."""
    cells = corner + np.stack([_gather(codes >> 2), _gather(codes >> 1), _gather(codes)], 1)
    return torch.from_numpy((cells + 0.5) * resolution)


# -- bytes -------------------------------------------------------------------------------------------------


def header(corner: Ints, n: int) -> bytes:
    """A corner (3,) and a number as variable-length signed integers."""
    writer = BitWriter()
    for value in [*corner.tolist(), n]:
        writer.number(value)
    return writer.to_bytes()


def read_header(data: bytes) -> tuple[Ints, int, bytes]:
    """Corner (3,), number, and the bytes after the header."""
    reader = BitReader(data)
    corner, n = np.array([reader.number() for _ in range(3)]), reader.number()
    if np.abs(corner.astype(np.float64)).max() > 2.0**53 or n < 0:
        raise DataError(f"corner={corner.tolist()} cells or n={n} points is out of range.")
    return corner, n, data[len(data) - reader.left // 8 :]


_GROUPS = 9  # of 7 bits in 63


def grouped(numbers: Ints) -> bytes:
    """Numbers ≥ 0 in groups of 7 bits, each with a continuation bit; all lowest groups come first."""
    planes = []
    while len(numbers):
        more = numbers > 0x7F
        planes.append((numbers & 0x7F | more << 7).astype(np.uint8).tobytes())
        numbers = numbers[more] >> 7
    return b"".join(planes)


def ungrouped(data: bytes, n: int) -> Ints:
    """The inverse of `grouped`: n numbers. Raises `DataError` for truncated or extra bytes."""
    left = np.frombuffer(data, np.uint8).astype(np.int64)
    if n > len(left):
        raise DataError(f"The header states {n} numbers, but only {len(left)} bytes follow.")
    numbers, longer = np.zeros(n, np.int64), np.arange(n)
    for group in range(_GROUPS):
        here, left = left[: len(longer)], left[len(longer) :]
        if len(here) < len(longer):
            raise DataError("Numbers are truncated.")
        numbers[longer] |= (here & 0x7F) << 7 * group
        longer = longer[here > 0x7F]
    if len(longer) or len(left):
        raise DataError("A number is too long, or extra bytes follow.")
    return numbers


def compressed(data: bytes) -> bytes:
    """The bytes as a zstd frame without magic number, length and checksum."""
    zstd = library("zstandard")
    parameters = zstd.ZstdCompressionParameters.from_level(
        _LEVEL,
        source_size=len(data),
        format=zstd.FORMAT_ZSTD1_MAGICLESS,
        write_content_size=False,
        write_checksum=False,
    )
    frame: bytes = zstd.ZstdCompressor(compression_params=parameters).compress(data)
    return frame


def decompressed(data: bytes) -> bytes:
    """The inverse of `compressed`; raises `DataError` for invalid bytes."""
    zstd = library("zstandard")
    try:
        frame = zstd.get_frame_parameters(data, format=zstd.FORMAT_ZSTD1_MAGICLESS)
        if frame.content_size != zstd.CONTENTSIZE_UNKNOWN:  # zstd would allocate this size, however large
            raise DataError("The zstd frame has a content size, which this codec never writes.")
        decompressor = zstd.ZstdDecompressor(format=zstd.FORMAT_ZSTD1_MAGICLESS)
        content: bytes = decompressor.decompress(data, max_output_size=_LARGEST_OUTPUT)
    except zstd.ZstdError as error:
        raise DataError(f"zstd cannot decompress these bytes: {error}.") from error
    return content


def library(name: str) -> Any:
    """The module zstandard or DracoPy, which only the point codecs need."""
    with needs_extra("The point codecs need", name, "baselines"):
        return importlib.import_module(name)
