"""Logs of scans: of 2D lasers in the form of CARMEN, and scan graphs of OctoMap.

CARMEN logs of 2D lasers (the Radish collection and many others), gzip or plain text.

Only lines `FLASER n r_1 … r_n x y theta …` are read: n ranges (m) and the pose of the laser (m, rad), which
is corrected by SLAM in corrected logs. Beam angles, 0 = forward: −90° + i·1° for n = 180, −90° + i·0.5° for
n = 360, and n beams spread evenly over [−90°, 90°] for any other n.

Scan graphs of OctoMap: text logs, the format of the Freiburg campus scans, and binary `.graph` files.

In a text log, a line `NODE x y z roll pitch yaw` (metres, radians; R = Rz(yaw) Ry(pitch) Rx(roll), world ←
sensor) starts a scan. The lines up to the next NODE are its points in the sensor frame, three numbers each.
Blank lines and comments (#) are skipped. A binary graph is little endian:

    u32 n, n nodes, u32 m, m edges
    node   u32 k, k points in the sensor frame (m), pose, u32 id
    pose   translation (m), quaternion w x y z; world ← sensor
    edge   two u32 ids, pose, f64 weight

Points, translations and quaternions are vectors: an i32 with their length, 3 or 4, and as many f64.
"""

from __future__ import annotations

import io
import math
import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import Dataset, Ranges, gunzip, number_rows, require_path
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_MAX_BEAMS = 100_000


def beam_angles(n: int) -> Tensor:
    """Beam angles (n,) of a front laser in radians, 0 = forward, counter-clockwise."""
    if n in (180, 360):
        return (torch.arange(n, dtype=torch.float64) * (180 / n) - 90).deg2rad()
    return torch.linspace(-math.pi / 2, math.pi / 2, n, dtype=torch.float64)


class CarmenLog(Dataset):
    """Scans of a CARMEN log in the order of the file. Times are the stamps of the logger; there are none if a
    line lacks one, or if they do not increase.

    Readings at or beyond `max_range` have no return; the Radish logs use 81.83, 81.91 or 50 m as code for "no
    return". Readings of zero or less, and NaN, are invalid and dropped.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
        path = require_path(
            path,
            "file",
            "a CARMEN log (text or gzip) with FLASER lines",
            "Such logs are published in the Radish repository and the SLAM benchmarking pages of Freiburg.",
        )
        super().__init__(path.name.split(".")[0], ranges, stride)
        self._records, stamps = _read_records(path)
        ordered = bool((stamps.diff() > 0).all())  # false for NaN
        self._times = stamps if ordered and bool(torch.isfinite(stamps).all()) else None

    def _count(self) -> int:
        return len(self._records)

    def _read(self, index: int) -> Scan:
        record = self._records[index]
        readings, (x, y, theta) = record[:-3], record[-3:]
        angles = beam_angles(readings.shape[0]) + theta
        origin = torch.stack([x, y])
        valid = readings > 0  # false for NaN
        if self.ranges.max_range is not None:
            readings = readings.clamp_max(self.ranges.max_range)  # some lasers report infinity
        ends = origin + readings[valid, None] * torch.stack([angles.cos(), angles.sin()], 1)[valid]
        return self.ranges.scan(ends, origin)

    def _known_pose(self, index: int) -> Tensor:
        x, y, theta = self._records[index][-3:]
        return Pose.from_yaw(theta, torch.stack([x, y])).matrix


def _read_records(path: Path) -> tuple[list[Tensor], Tensor]:
    """One tensor [r_1 … r_n, x, y, theta] for each FLASER line, and their stamps (s); NaN: no stamp."""
    data = gunzip(path)
    records, stamps = [], []
    with path.open("rb") if data is None else io.BytesIO(data) as file:
        for number, line in enumerate(io.TextIOWrapper(file, errors="replace"), 1):
            if line.startswith("FLASER "):
                words = line.split()
                records.append(_parse(words, path, number))
                stamps.append(_stamp(words))
    if not records:
        raise DataError(f"{path} has no FLASER line, so it is not a CARMEN log of a front laser.")
    return records, torch.tensor(stamps, dtype=torch.float64)


def _stamp(words: list[str]) -> float:
    """The stamp that follows the corrected pose and the odometry of a FLASER line; NaN without one."""
    try:
        return float(words[2 + int(words[1]) + 6])
    except (IndexError, ValueError):
        return math.nan


def _parse(words: list[str], path: Path, number: int) -> Tensor:
    """[r_1 … r_n, x, y, theta] of the words of the line with this number."""
    where = f"{path}, line {number}"
    n = int(words[1]) if len(words) > 1 and words[1].isdecimal() else 0
    if not 1 <= n <= _MAX_BEAMS:
        raise DataError(
            f"{where}: FLASER announces {' '.join(words[1:2]) or 'no'} beams; expected 1 to {_MAX_BEAMS}."
        )
    if len(words) < 2 + n + 3:
        raise DataError(f"{where}: FLASER announces {n} beams, but the line ends early.")
    numbers = number_rows([" ".join(words[2 : 2 + n + 3])], n + 3, f"{path}, line", number)
    record = torch.from_numpy(numbers[0])
    if not bool(torch.isfinite(record[-3:]).all()):
        raise DataError(f"{where}: the pose {record[-3:].tolist()} is not finite.")
    return record


_LINE_BYTES = 1 << 12
_COUNT = struct.Struct("<I")
_POINT = np.dtype([("length", "<i4"), ("values", "<f8", 3)])
_POSE = struct.Struct("<i3di4d")
_EDGE_BYTES = 2 * _COUNT.size + _POSE.size + 8
_NORM_ERROR = 1e-2


class OctomapLog(Dataset):
    """Scans of a log, text or binary, in the order of the file. Only their positions in the file are kept in
    memory.

    Points at or beyond `max_range` have no return. NaN, infinite points and points at the sensor origin are
    invalid and dropped. A gzip file is decompressed into memory once.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
        self._path = require_path(
            path,
            "file",
            "an OctoMap scan log (NODE x y z roll pitch yaw, then points) or binary scan graph",
            "The OctoMap 3D scan dataset of the University of Freiburg is published in this format.",
        )
        super().__init__(self._path.name.split(".")[0], ranges, stride)
        self._unzipped = gunzip(self._path)
        with self._open() as file:
            # A text log has no zero byte, the first counts of a graph have some.
            self._is_binary = b"\0" in file.read(2 * _COUNT.size)
            file.seek(0)
            self._nodes = (_binary_nodes if self._is_binary else _node_positions)(file, str(self._path))
        if not self._nodes:
            missing = "scan" if self._is_binary else "NODE line, so it is not an OctoMap scan log"
            raise DataError(f"{self._path} has no {missing}.")

    def _open(self) -> io.BufferedIOBase:
        return self._path.open("rb") if self._unzipped is None else io.BytesIO(self._unzipped)

    def _count(self) -> int:
        return len(self._nodes)

    def _read(self, index: int) -> Scan:
        return self.ranges.posed(self._points(index), self._known_pose(index))

    def _points(self, index: int) -> Tensor:
        """Points (N, 3) of a scan, sensor frame."""
        where = f"{self._path}, scan {index}"
        if self._is_binary:
            with self._open() as file:
                file.seek(self._nodes[index])
                n_points = _count(file, where)
                points = np.frombuffer(file.read(n_points * _POINT.itemsize), _POINT)
            if not (points["length"] == 3).all():
                raise DataError(f"{where} has points that are not three numbers; the file is damaged.")
            return torch.from_numpy(points["values"].astype(np.float64))
        stop = self._nodes[index + 1] if index + 1 < len(self._nodes) else None
        with self._open() as file:
            file.seek(self._nodes[index])
            text = file.read() if stop is None else file.read(stop - self._nodes[index])
        _, *lines = text.decode("ascii", errors="replace").splitlines()
        lines = [line for line in lines if line.strip() and not line.startswith("#")]
        return torch.from_numpy(number_rows(lines, 3, f"{where}, row"))

    def _known_pose(self, index: int) -> Tensor:
        where = f"{self._path}, scan {index}"
        with self._open() as file:
            file.seek(self._nodes[index])
            if self._is_binary:
                return _read_pose(file, where)
            line = file.readline(_LINE_BYTES).decode("ascii", errors="replace")
        numbers = number_rows([line.removeprefix("NODE")], 6, where + ", NODE line")[0]
        if not np.isfinite(numbers).all():
            raise DataError(f"{where}: the pose {numbers.tolist()} is not finite.")
        return Pose(rotation(*numbers[3:]), torch.from_numpy(numbers[:3])).matrix


def rotation(roll: float, pitch: float, yaw: float) -> Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3), from angles in radians."""
    x, y, z = Pose.from_turn(torch.diag(torch.tensor([roll, pitch, yaw], dtype=torch.float64))).rotation
    return z @ y @ x


def _node_positions(file: io.BufferedIOBase, where: str) -> list[int]:
    """Byte positions of the NODE lines in the file."""
    positions, position = [], 0
    for line in file:
        if line.startswith(b"NODE"):
            positions.append(position)
        position += len(line)
    return positions


def _binary_nodes(file: io.BufferedIOBase, where: str) -> list[int]:
    """Byte positions of the nodes in the file, whose sizes are all checked against its length."""
    length = file.seek(0, io.SEEK_END)
    file.seek(0)
    positions = []
    for node in range(_count(file, where)):
        positions.append(file.tell())
        _pose_numbers(file, f"{where}, scan {node}")
        _count(file, where)  # its id
    n_edges = _count(file, where)
    left = length - file.tell()
    if n_edges * _EDGE_BYTES != left:
        raise DataError(
            f"{where} announces {n_edges} edges after its {len(positions)} scans, but has {left} bytes; it "
            "is damaged, so fetch it again."
        )
    return positions


def _count(file: io.BufferedIOBase, where: str) -> int:
    """The number at the position of the file."""
    data = file.read(_COUNT.size)
    if len(data) < _COUNT.size:
        raise DataError(f"{where} ends where a number is expected; it is cut off, so fetch it again.")
    return int(_COUNT.unpack(data)[0])


def _pose_numbers(file: io.BufferedIOBase, where: str) -> tuple[float, ...]:
    """x, y, z, w, x, y, z of the pose of the node at the position of the file, which is then after it."""
    n_points = _count(file, where)
    file.seek(n_points * _POINT.itemsize, io.SEEK_CUR)
    data = file.read(_POSE.size)
    if len(data) < _POSE.size:
        raise DataError(
            f"{where} announces {n_points} points, which the file is too short for; it is cut off, or not a "
            "scan graph of OctoMap."
        )
    three, x, y, z, four, *quaternion = _POSE.unpack(data)
    if (three, four) != (3, 4):
        raise DataError(f"{where} has no pose where one is expected; this is not a scan graph of OctoMap.")
    return x, y, z, *quaternion


def _read_pose(file: io.BufferedIOBase, where: str) -> Tensor:
    """Pose (4, 4), world ← sensor, of the node at the position of the file."""
    x, y, z, *quaternion = _pose_numbers(file, where)
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) < _NORM_ERROR:
        raise DataError(f"{where}: the quaternion {quaternion} has length {norm:.3g} instead of 1.")
    if not all(map(math.isfinite, (x, y, z))):
        raise DataError(f"{where} is not a rigid pose: its position {[x, y, z]} is not finite.")
    w, *axis = quaternion
    return Pose.from_quaternion([x, y, z], [*axis, w]).matrix
