"""Point codecs: other ways to send the novel points of a frame, for comparison with mixtures.

Each codec is as favourable to the points as possible; docs/messages.md describes them.
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_number
from gmmtorch.mapping import BitReader, BitWriter, Ints, unzigzag, zigzag
from gmmtorch.occupancy import check_resolution
from gmmtorch.optional_packages import needs_extra

MOST_BITS = 21
"""Bits of a cell index along an axis; three axes fit into 63 bits."""
_LEVEL = 22  # the strongest of zstd
_LARGEST_OUTPUT = 1 << 26  # bytes that zstd may decompress to


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


FARTHEST = 2.0**14
"""Largest coordinate (m) of `RawPoints`; beyond it the spacing of float32 exceeds a millimetre."""
POINT_CODECS = ("raw", "quantized", "octree", "draco")
"""Names that `point_codec` accepts."""
_DRACO_BITS = 30
_DRACO_LEVEL = 10  # the strongest
_DEEPEST = (1 << 16) - 1


# `encode` makes bytes of points (N, 3), metres; raises `InvalidArgumentError` for those that it cannot store.
# `decode` returns points (M, 3), float64, in any order; raises `DataError` for invalid bytes.


@dataclass(frozen=True)
class RawPoints:
    """12 bytes for each point: three float32, in order."""

    name: ClassVar[str] = "raw"

    def encode(self, points: Tensor) -> bytes:
        rows = checked_points(points)
        if len(rows) and not float(np.abs(rows).max()) < FARTHEST:
            raise InvalidArgumentError(
                f"points lie up to {np.abs(rows).max():g} m from the origin, where float32 is coarser than a "
                "millimetre; give them relative to the sensor."
            )
        return rows.astype("<f4").tobytes()

    def decode(self, data: bytes) -> Tensor:
        if len(data) % 12:
            raise DataError(f"{len(data)} bytes are not a multiple of 12 bytes, the size of a point.")
        rows = np.frombuffer(data, "<f4").reshape(-1, 3)
        if not np.isfinite(rows).all():
            raise DataError("A decoded point is NaN or infinite.")
        return torch.from_numpy(rows.astype(np.float64))


@dataclass(frozen=True)
class QuantizedPoints:
    """Rounds each point to the centre of its cell of side `resolution` (m). Sorts the cells along a Morton
    curve, writes the differences as 1 to 9 groups of 7 bits, grouped by their significance, and compresses
    them with zstd."""

    resolution: float
    name: ClassVar[str] = "quantized"

    def __post_init__(self) -> None:
        check_resolution(self.resolution)

    def encode(self, points: Tensor) -> bytes:
        corner, codes, _ = morton_codes(points, self.resolution)
        codes = np.sort(codes)
        steps = codes - np.concatenate([np.zeros(1, np.int64), codes])[:-1]
        return header(corner, len(codes)) + compressed(grouped(steps))

    def decode(self, data: bytes) -> Tensor:
        corner, n, rest = read_header(data)
        steps = ungrouped(decompressed(rest), n)
        if float(steps.astype(np.float64).sum()) >= 2.0 ** (3 * MOST_BITS):
            raise DataError("A cell index is out of range.")
        return centers(corner, np.cumsum(steps), self.resolution)


@dataclass(frozen=True)
class Octree:
    """The occupied cells of side `resolution` (m) as an octree; each cell is stored once. Writes a byte for
    each inner node, level by level from the root, where bit i stands for child i = 4x + 2y + z, and
    compresses the bytes with zstd. Decodes to the centres of the cells."""

    resolution: float
    name: ClassVar[str] = "octree"

    def __post_init__(self) -> None:
        check_resolution(self.resolution)

    def encode(self, points: Tensor) -> bytes:
        corner, codes, depth = morton_codes(points, self.resolution)
        nodes, levels = np.unique(codes), []
        for _ in range(depth if len(codes) else 0):
            parents = nodes >> 3
            starts = np.flatnonzero(np.diff(parents, prepend=-1))
            levels.append(np.bitwise_or.reduceat(np.left_shift(1, nodes & 7), starts).astype(np.uint8))
            nodes = parents[starts]
        occupancy = b"".join(level.tobytes() for level in reversed(levels))
        return header(corner, 1 + depth if len(codes) else 0) + compressed(occupancy)

    def decode(self, data: bytes) -> Tensor:
        corner, levels, rest = read_header(data)
        if levels > 1 + MOST_BITS:
            raise DataError(f"The octree has {levels} levels; at most {1 + MOST_BITS} are supported.")
        occupancy = np.frombuffer(decompressed(rest), np.uint8)
        nodes = np.zeros(min(levels, 1), np.int64)
        for _ in range(levels - 1):
            if len(nodes) > len(occupancy):
                raise DataError("The octree is truncated.")
            here, occupancy = occupancy[: len(nodes)], occupancy[len(nodes) :]
            parent, child = np.nonzero(np.unpackbits(here[:, None], axis=1, bitorder="little"))
            nodes = nodes[parent] << 3 | child
        if len(occupancy):
            raise DataError("Extra bytes follow the octree.")
        return centers(corner, nodes, self.resolution)


@dataclass(frozen=True)
class Draco:
    """Draco's k-d tree of points on a lattice whose error is at most `error` (m, RMS). The lattice step is
    about 2 · error, which is exact for uniformly distributed points. By default Draco divides the extent by a
    power of two, and its lattice would be up to twice as fine as necessary."""

    error: float
    name: ClassVar[str] = "draco"

    def __post_init__(self) -> None:
        check_number("error", self.error, above=True)

    def encode(self, points: Tensor) -> bytes:
        rows = checked_points(points)
        corner = np.floor(rows.min(0)).astype(np.int64) if len(rows) else np.zeros(3, np.int64)
        start = header(corner, len(rows))
        if not len(rows):
            return start
        step, bits = _draco_step(rows - corner, self.error)
        encoded: bytes = library("DracoPy").encode(
            (rows - corner).astype(np.float32),  # the only type that Draco accepts
            quantization_bits=bits,
            compression_level=_DRACO_LEVEL,
            quantization_range=step * ((1 << bits) - 1),
            quantization_origin=np.zeros(3),
        )
        return start + encoded

    def decode(self, data: bytes) -> Tensor:
        corner, n, rest = read_header(data)
        if n == 0:
            return torch.zeros(0, 3, dtype=torch.float64)
        try:
            rows = np.asarray(library("DracoPy").decode(rest).points, np.float64).reshape(-1, 3)
        except Exception as error:  # DracoPy has errors of its own
            raise DataError(f"Draco cannot decode these bytes: {error}.") from error
        if not 0 < len(rows) <= n or not np.isfinite(rows).all():  # Draco merges equal points
            raise DataError(f"Draco decoded {len(rows)} points, but the header states {n}.")
        return torch.from_numpy(rows + corner)


@dataclass(frozen=True)
class DepthImage:
    """A depth image (H, W), rounded to multiples of `step` (m); 0 means no depth.

    Writes a validity bit for each pixel, then the difference of each valid depth to the previous valid depth,
    row by row, as 16-bit zigzag numbers with all high bytes before all low bytes; compresses them with zstd.
    Depths below half a step are lost.
    """

    step: float = 0.001
    name: ClassVar[str] = "depth_image"

    def __post_init__(self) -> None:
        check_number("step", self.step, above=True)

    @property
    def _per_metre(self) -> float:
        """Steps per metre; exactly 1000 for a millimetre, so that decoded depths are the nearest decimals."""
        return 1 / self.step

    def encode(self, depths: Tensor) -> bytes:
        """Encode depths (H, W), metres; 0 means no depth, NaN raises `InvalidArgumentError`."""
        image = depths.detach().double().cpu().numpy()
        if image.ndim != 2 or not ((image >= 0) & (image * self._per_metre <= _DEEPEST)).all():
            raise InvalidArgumentError(
                f"depths of shape {image.shape} must be (H, W), from 0 to {_DEEPEST * self.step:g} m."
            )
        steps = np.round(image * self._per_metre).astype(np.int64).ravel()
        present = steps > 0
        change = np.diff(steps[present], prepend=0)
        wrapped = (change + (1 << 15)) % (1 << 16) - (1 << 15)
        planes = zigzag(wrapped).astype(">u2").view(np.uint8).reshape(-1, 2).T
        body = np.packbits(present).tobytes() + planes.tobytes()
        return header(np.array([*image.shape, 0]), 0) + compressed(body)

    def decode(self, data: bytes) -> Tensor:
        """Decode to depths (H, W), metres, float64. Raises `DataError` for invalid bytes."""
        (height, width, _), _, rest = read_header(data)
        n = int(height) * int(width)
        body = np.frombuffer(decompressed(rest), np.uint8)
        if min(height, width) < 0 or (n + 7) // 8 > len(body):
            raise DataError(f"{len(body)} bytes are not an image of {height} by {width} pixels.")
        present = np.unpackbits(body[: (n + 7) // 8])[:n].astype(bool)
        planes = body[(n + 7) // 8 :]
        if len(planes) != 2 * present.sum():
            raise DataError(f"{len(planes)} bytes are not the depths of {present.sum()} pixels.")
        codes = np.ascontiguousarray(planes.reshape(2, -1).T).view(">u2").ravel().astype(np.int64)
        steps = np.zeros(n, np.int64)
        steps[present] = np.cumsum(unzigzag(codes)) % (1 << 16)
        return torch.from_numpy(steps.reshape(int(height), int(width)) / self._per_metre)


PointCodec = RawPoints | QuantizedPoints | Octree | Draco


def point_codec(name: str, resolution: float, target_error: float) -> PointCodec:
    """The codec with this name; `resolution` (m) is the cell size, `target_error` (m, RMS) is for Draco."""
    check_choice("name", name, POINT_CODECS)
    if name == "raw":
        return RawPoints()
    if name == "draco":
        return Draco(target_error)
    return Octree(resolution) if name == "octree" else QuantizedPoints(resolution)


def bytes_of_points(
    points: Tensor,
    resolution: float,
    target_error: float,
    depths: Tensor | None = None,
    names: Sequence[str] = POINT_CODECS,
) -> dict[str, int]:
    """Bytes of a frame's points (N, 3) in each codec, by name; 0 bytes without points.

    resolution: cell size (m) of octree and lattice; the RMS error of a point is half of it. target_error: RMS
    error (m) of Draco's points. depths: (H, W) image of the same points, metres, 0 elsewhere; None leaves the
    depth image out. names: names from `POINT_CODECS`.
    """
    sizes = {}
    for name in names:
        codec = point_codec(name, resolution, target_error)
        sizes[name] = len(codec.encode(points)) if len(points) else 0
    if depths is not None:
        sizes[DepthImage.name] = len(DepthImage().encode(depths)) if len(points) else 0
    return sizes


def _draco_step(rows: NDArray[np.float64], error: float) -> tuple[float, int]:
    """Step (m) of a lattice whose RMS error for rows (N, 3) ≥ 0 is at most `error`, and bits per axis. The
    RMS error of uniformly distributed points is step / 2. For other points it may be larger; then the step is
    reduced."""
    step = 2 * error
    while True:
        bits = max(1, math.ceil(math.log2(float(rows.max()) / step + 2)))
        if bits > _DRACO_BITS:
            raise InvalidArgumentError(
                f"error={error:g} m over {rows.max():g} m needs more than Draco's {_DRACO_BITS} bits, or "
                "than float32 has; allow a larger error, or encode fewer points at once."
            )
        rounded = np.round(rows.astype(np.float32) / step) * step
        found = math.sqrt(float(np.square(rows - rounded).sum(1).mean()))
        if found <= error:
            return step, bits
        step *= 0.99 * error / found
