"""Data sets: sequences of scans, each read when it is accessed; and the share of a robot."""

from __future__ import annotations

import contextlib
import gzip
import math
import re
import zlib
from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import overload

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import DataError, InvalidArgumentError, MissingDataError, check_whole
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_ROUNDING = 1e-6
"""Upper bound of the relative rounding error of a range recomputed from rotated float32 coordinates."""

_ROUNDED_ROTATION = 1e-2  # largest error of an entry of R Rᵀ
_MAX_TEXT_BYTES = 1 << 28
_GZIP_BLOCK_BYTES = 1 << 20


def is_beyond(distance: Tensor, max_range: float) -> Tensor:
    """Whether each distance (m) is at or beyond `max_range`, within rounding."""
    return distance >= max_range * (1 - _ROUNDING)


@dataclass(frozen=True)
class Ranges:
    """How range readings are interpreted.

    max_range: a reading at this distance (m) or beyond is a beam without return; None: no limit.
    no_return_range: length (m) of free space along a beam without return; 0: such beams are dropped.
    """

    max_range: float | None = None
    no_return_range: float = 0.0

    def __post_init__(self) -> None:
        if self.max_range is not None and not self.max_range > 0:
            raise InvalidArgumentError(
                f"max_range={self.max_range} must be above zero metres, or .inf (math.inf) for no limit."
            )
        if not (math.isfinite(self.no_return_range) and self.no_return_range >= 0):
            raise InvalidArgumentError(
                f"no_return_range={self.no_return_range} must be zero (ignore beams without return) "
                "or a distance in metres."
            )

    def scan(
        self,
        ends: ArrayLike,
        origin: ArrayLike,
        no_return: ArrayLike | None = None,
        attributes: Mapping[str, Tensor] | None = None,
    ) -> Scan:
        """A scan from beam ends (N, D) and the sensor origin (D,), world frame, metres.

        Ends at or beyond `max_range`, and those marked in `no_return` (N,), become beams without return.
        Their free part is `no_return_range` metres long, or as long as the beam if that is shorter. Ends
        that are not finite or equal the sensor origin are invalid and dropped. `attributes`: channels of the
        ends, see `Scan`.
        """
        ends = as_tensor(ends, "ends")
        origin = as_tensor(origin, "origin", device=ends.device)
        offset = ends - origin
        distance = offset.norm(dim=1)
        valid = torch.isfinite(distance) & (distance > 0)
        empty = torch.zeros_like(valid)
        if no_return is not None:
            empty |= as_tensor(no_return, "no_return", torch.bool, ends.device)
        if self.max_range is not None:
            empty |= is_beyond(distance, self.max_range)
        hit, empty = valid & ~empty, valid & empty
        channels = {name: value[hit] for name, value in (attributes or {}).items()}
        if self.no_return_range == 0:
            return Scan(ends[hit], origin, attributes=channels)
        free_length = distance[empty].clamp_max(self.no_return_range)
        if self.max_range is not None:
            free_length = free_length.clamp_max(self.max_range)
        free = origin + offset[empty] * (free_length / distance[empty])[:, None]
        return Scan(ends[hit], origin, free, attributes=channels)

    def posed(self, points: Tensor, pose: Tensor, attributes: Mapping[str, Tensor] | None = None) -> Scan:
        """A scan from points (N, 3) in the sensor frame and the pose (4, 4), world ← sensor; see `scan`."""
        return self.scan(Pose.from_matrix(pose).apply(points), pose[:3, 3], None, attributes)


NO_POSE = "no pose at the time of the scan"
"""Why a scan is left out, in `Dataset.skipped`."""


class Dataset(Sequence[Scan]):
    """Scans in the order of their recording.

    Subclasses implement `_read`, and set `_files`, one for each scan, or implement `_count`. If the source
    has poses (N, D+1, D+1), world ← sensor, or times (N,) in seconds, float64, they set `_poses` or `_times`,
    or implement `_known_pose` or `_known_times`.

    Attributes:
        name: of the data set.
        ranges: how readings are interpreted.
        stride: every n-th scan of the source is read.
        attributes: channels of the points that are read, if a scan has them.
        n_sensors: that the scans are of.
        keeps_point_times: scans that are not deskewed have the channel `POINT_TIMES`, if the source has it.
    """

    attributes: tuple[str, ...] = ()
    n_sensors = 1
    keeps_point_times = False
    _files: Sequence[Path]
    _poses: Tensor | None = None
    _times: Tensor | None = None

    def __init__(self, name: str, ranges: Ranges, stride: int = 1) -> None:
        if stride < 1:
            raise InvalidArgumentError(f"stride={stride} must be at least 1: every n-th scan is read.")
        self.name = name
        self.ranges = ranges
        self.stride = stride
        self._skipped: dict[str, set[int]] = {}

    def _count(self) -> int:
        """Number of scans in the source."""
        return len(self._files)

    @abstractmethod
    def _read(self, index: int) -> Scan:
        """Scan `index` of the source."""

    def _known_pose(self, index: int) -> Tensor | None:
        """Sensor pose of scan `index` of the source; None if the source has no poses."""
        return None if self._poses is None else self._poses[index]

    def _known_times(self) -> Tensor | None:
        """Times (s), float64, of all scans of the source; None if the source has no usable times."""
        return self._times

    def _known_time(self, index: int) -> float | None:
        """Time (s) of scan `index` of the source; None if the source has no usable times."""
        times = self._known_times()
        return None if times is None else float(times[index])

    def pose(self, index: int) -> Tensor | None:
        """Pose (D+1, D+1) of the sensor for scan `index`, world ← sensor, float64, metres.

        None if the source does not state it. The translation is the origin of the scan.
        """
        return self._known_pose(self._position(index))

    @property
    def times(self) -> Tensor | None:
        """Times (N,) of the scans in seconds, float64; None if the source has no usable times."""
        times = self._known_times()
        return None if times is None else times[:: self.stride]

    def sensor_of(self, index: int) -> int:
        """The number, from 0, of the sensor of scan `index`."""
        return 0

    def check_one_sensor(self, what: str) -> None:
        """Raises `InvalidArgumentError` if scans are of several sensors. what: needs those of one."""
        if self.n_sensors > 1:
            raise InvalidArgumentError(
                f"‹topic› has {self.n_sensors} topics, and {what} follows one sensor; choose one ‹topic›."
            )

    def turns(self) -> Tensor:
        """Rotations (N, D, D) of the sensor since the scan before, before ← now, float64, by an IMU.

        The first is the identity; unknown ones are NaN. Raises `InvalidArgumentError` without an IMU.
        """
        raise InvalidArgumentError(
            f"motion=imu cannot be used: it needs the IMU of a ROS bag, and the scans of {self.name} are not "
            "read from one, or have estimated poses. Predict with ‹motion›=constant or ‹motion›=dataset."
        )

    @property
    def skipped(self) -> dict[str, int]:
        """Reason → number of scans that are left out for it, returned without points because their
        data is unusable, or not deskewed, or that lack points whose times or coordinates are wrong.

        Empty if nothing is wrong. Damage inside a scan is counted when that scan is read, so the counts are
        final after the last scan.
        """
        return {reason: len(scans) for reason, scans in self._skipped.items()}

    def _note_missing(self, channels: Collection[str], index: int) -> None:
        """Counts a scan with only these of the `attributes`."""
        for name in (name for name in self.attributes if name not in channels):
            self._skip(f"read without {name}, which they lack", index)

    def can_continue(self, n_read: int) -> bool:
        """Whether reading can go on after `n_read` scans that were read in an earlier run."""
        return 0 <= n_read <= len(self)

    def _skip(self, reason: str, *indices: int) -> None:
        """Counts messages or files of the source as skipped; each once, however often it is read."""
        if indices:
            self._skipped.setdefault(reason, set()).update(indices)

    def __len__(self) -> int:
        return -(-self._count() // self.stride)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> list[Scan]: ...
    def __getitem__(self, index: int | slice) -> Scan | list[Scan]:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        position = self._position(index)
        scan, time = self._read(position), self._known_time(position)
        return scan if time is None else replace(scan, time=time)

    def _position(self, index: int) -> int:
        """Position in the source of scan `index` of the data set; a negative index counts from the end."""
        position = index + len(self) if index < 0 else index
        if not 0 <= position < len(self):
            raise IndexError(f"scan {index} of {self.name}, which has {len(self)}")
        return position * self.stride

    def __iter__(self) -> Iterator[Scan]:
        return map(self.__getitem__, range(len(self)))


def require_path(path: str | Path, kind: str, content: str, source: str) -> Path:
    """The path, with ~ expanded, if a `kind` ("file", "folder", or any other word for both) exists there.

    Raises `InvalidArgumentError` for an empty path and `MissingDataError` for a missing one; the message
    states the expected `content` and a `source` of such data.
    """
    if path is None or str(path) == "":
        raise InvalidArgumentError(f"‹path› is not set; give a {kind} with {content}. {source}")
    path = Path(path).expanduser()
    exists = {"file": path.is_file, "folder": path.is_dir}.get(kind, path.exists)
    if not exists():
        what = "is not a " + kind if path.exists() else "does not exist"
        raise MissingDataError(f"‹path›={path} {what}; looked for {content}. {source}")
    return path


def natural_key(path: Path) -> list[tuple[int, int | str]]:
    """Sort key of file names that orders scan_2 before scan_10."""
    return [(0, int(w)) if w.isdecimal() else (1, w) for w in re.split(r"(\d+)", path.name)]


def check_poses(matrices: Tensor, where: str) -> Tensor:
    """The poses (N, 4, 4) or (4, 4), world ← sensor, as files state them, whose rotations are rounded.

    Raises `DataError`, which begins with `where` and the number of the row from 1, unless they are rigid.
    """
    rotation = matrices[..., :3, :3]
    error = (rotation @ rotation.mT - torch.eye(3, dtype=matrices.dtype)).abs().amax((-2, -1))
    finite = torch.isfinite(matrices).flatten(-2).all(-1)
    bad = ~(finite & (error < _ROUNDED_ROTATION) & (torch.linalg.det(rotation) > 0))
    if bool(bad.any()):
        row = int(bad.reshape(-1).nonzero()[0])
        raise DataError(
            f"{where}{f' {row + 1}' if bad.ndim else ''} is not a rigid pose (rotation off by "
            f"{float(error.reshape(-1)[row]):.2g}); expected world ← sensor, a rotation matrix and a "
            "translation in metres."
        )
    return matrices


def gunzip(path: Path) -> bytes | None:
    """The content of a gzip file; None if the file is not gzip.

    Raises `DataError` if it is damaged or contains more than `_MAX_TEXT_BYTES`.
    """
    with path.open("rb") as file:
        if file.read(2) != b"\x1f\x8b":
            return None
    try:
        blocks, length = [], 0
        with gzip.open(path) as file:
            while block := file.read(_GZIP_BLOCK_BYTES):
                blocks.append(block)
                length += len(block)
                if length > _MAX_TEXT_BYTES:
                    raise DataError(
                        f"{path} contains more than {_MAX_TEXT_BYTES:,} bytes; give the text file "
                        "that gunzip makes of it."
                    )
        return b"".join(blocks)
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise DataError(f"{path} is not a complete gzip file ({error}); fetch it again.") from error


SPLITS = ("interleaved", "consecutive")


def shard_indices(n_scans: int, k: int, n: int, split: str = "interleaved") -> range:
    """Indices of the scans of robot k of n.

    "interleaved" takes every n-th scan from scan k on; "consecutive" takes the k-th of n equal intervals.
    """
    check_whole("n_scans", n_scans, 0)
    if check_whole("k", k, 0) >= check_whole("n", n, 1):
        raise InvalidArgumentError(f"k={k} must be below n={n}: robots are counted from 0.")
    if split not in SPLITS:
        raise InvalidArgumentError(f"split={split!r} is not one of {', '.join(SPLITS)}.")
    if split == "interleaved":
        return range(k, n_scans, n)
    return range(n_scans * k // n, n_scans * (k + 1) // n)


class DatasetShard(Sequence[Scan]):
    """A selection of the scans of a data set, each read when it is accessed.

    Args:
        scans: the data set.
        indices: of the selected scans, in order, for example `shard_indices(len(scans), k, n)`.
        transform: (D+1, D+1) rigid motion of each scan; None: none.
    """

    def __init__(
        self, scans: Sequence[Scan], indices: Sequence[int], transform: Tensor | None = None
    ) -> None:
        self._scans, self._indices, self._transform = scans, indices, transform

    def __len__(self) -> int:
        return len(self._indices)

    @overload
    def __getitem__(self, index: int) -> Scan: ...
    @overload
    def __getitem__(self, index: slice) -> DatasetShard: ...
    def __getitem__(self, index: int | slice) -> Scan | DatasetShard:
        if isinstance(index, slice):
            return DatasetShard(self._scans, self._indices[index], self._transform)
        scan = self._scans[self._indices[index]]
        return scan if self._transform is None else scan.transformed(self._transform)


def start_frame(scans: Dataset, index: int) -> Tensor:
    """The frame (D+1, D+1), world ← frame, of a robot that starts with a scan: its origin is the sensor's,
    and x points ahead. In 3D it is upright. Without poses it has the axes of the world.
    """
    pose, origin = scans.pose(index), scans[index].origin.double()
    yaw = 0.0 if pose is None else math.atan2(float(pose[1, 0]), float(pose[0, 0]))
    return Pose.from_yaw(yaw, origin).matrix


_NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?|[+-]?(?:nan|inf|infinity)", re.I | re.A)
# C runtimes print these, Microsoft's older ones rounded to the precision: 1.#QNAN, 1.#INF00, 1.#J, 1.$
_NOT_FINITE = re.compile(
    r"(?<!\S)[+-]?(?:nan(?:[qs]|\(\w*\))|1\.(?:#[a-z]+|\$)0*(?:e[+-]?\d+)?)(?!\S)", re.I | re.A
)
_SHOWN = 40  # characters of a word in an error


def number_rows(lines: Sequence[str], width: int | None, where: str, first: int = 1) -> np.ndarray:
    """Numbers (N, width), float64, of lines that are not blank. White space separates the numbers.

    Numbers are decimal, with a point. NaN and infinity are read in every spelling of C runtimes.

    Args:
        width: numbers in each line; None: as many as in the first line.
        where: beginning of errors, up to the number of the line, as in "a.pcd, row".
        first: number of the first line.

    Raises `DataError`, which names the line and the word, if a word is not a number or a line has another
    width.
    """
    if not lines:
        return np.empty((0, width or 0))
    width = width or len(lines[0].split())
    spellings = (None, _NOT_FINITE) if lines[0].strip() else ()
    for spelling in spellings:  # the second is rare, and takes longer than to read the numbers
        text = lines if spelling is None else [spelling.sub("nan", line) for line in lines]
        with contextlib.suppress(ValueError):
            table = np.loadtxt(text, np.float64, comments=None, ndmin=2)
            if table.shape == (len(lines), width):
                return table
    raise _bad_line(lines, width, where, first)


def _bad_line(lines: Sequence[str], width: int, where: str, first: int) -> DataError:
    """The error for the first line that is not `width` numbers."""
    for number, line in enumerate(lines, first):
        words = _NOT_FINITE.sub("nan", line).split()
        for word in words:
            if not _NUMBER.fullmatch(word):
                remedy = "write decimals with a point, not a comma" if "," in word else "write the file again"
                return DataError(f"{where} {number}: {word[:_SHOWN]!r} is not a number; {remedy}.")
        if len(words) != width:
            return DataError(
                f"{where} {number} has {len(words)} numbers instead of {width}; the file is truncated or "
                "damaged. Write it again."
            )
    return DataError(f"{where} {first} or a later one cannot be read as numbers; write the file again.")
