"""Scan graphs of OctoMap: text logs, the format of the Freiburg campus scans, and binary `.graph` files.

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

from gmmtorch.datasets.base import Dataset, Ranges, gunzip, require_path
from gmmtorch.datasets.number_rows import number_rows
from gmmtorch.errors import DataError
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan

_LINE_BYTES = 1 << 12
_COUNT = struct.Struct("<I")
_POINT = np.dtype([("length", "<i4"), ("values", "<f8", 3)])
_POSE = struct.Struct("<i3di4d")
_NODE_BYTES = 2 * _COUNT.size + _POSE.size  # of a node without points
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
            self._is_binary = _is_binary(file)
            file.seek(0)
            if self._is_binary:
                self._nodes = _binary_node_positions(file, str(self._path))
            else:
                self._nodes = _node_positions(file)
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
                return torch.from_numpy(_read_points(file, self._nodes[index], where))
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
            if self._is_binary:
                return _read_pose(file, self._nodes[index], where)
            file.seek(self._nodes[index])
            head = file.readline(_LINE_BYTES).decode("ascii", errors="replace")
        return _node_pose(head, where)


def _node_pose(line: str, where: str) -> Tensor:
    """The pose (4, 4) in a NODE line."""
    numbers = number_rows([line.removeprefix("NODE")], 6, where + ", NODE line")[0]
    if not np.isfinite(numbers).all():
        raise DataError(f"{where}: the pose {numbers.tolist()} is not finite.")
    return Pose(rotation(*numbers[3:]), torch.from_numpy(numbers[:3])).matrix


def rotation(roll: float, pitch: float, yaw: float) -> Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3), from angles in radians."""
    x, y, z = Pose.from_turn(torch.diag(torch.tensor([roll, pitch, yaw], dtype=torch.float64))).rotation
    return z @ y @ x


def _node_positions(file: io.BufferedIOBase) -> list[int]:
    """Byte positions of the NODE lines in the file."""
    positions, position = [], 0
    for line in file:
        if line.startswith(b"NODE"):
            positions.append(position)
        position += len(line)
    return positions


# -- binary graphs --------------------------------------------------------------------------------------


def _is_binary(file: io.BufferedIOBase) -> bool:
    """Whether the file is binary: a text log has no zero byte, the first counts of a graph have some."""
    file.seek(0)
    return b"\0" in file.read(2 * _COUNT.size)


def _binary_node_positions(file: io.BufferedIOBase, where: str) -> list[int]:
    """Byte positions of the nodes in the file, whose sizes are all checked against its length.

    Raises `DataError`, which begins with `where`, if the file is cut off or of another format.
    """
    length = file.seek(0, io.SEEK_END)
    positions, position = [], _COUNT.size
    for node in range(_count(file, 0, where)):
        if position + _NODE_BYTES > length:
            raise DataError(f"{where} ends within scan {node}; it is cut off, so fetch it again.")
        positions.append(position)
        _pose_numbers(file, position, length, f"{where}, scan {node}")
        position += _NODE_BYTES + _count(file, position, where) * _POINT.itemsize
    n_edges = _count(file, position, where)
    if position + _COUNT.size + n_edges * _EDGE_BYTES != length:
        raise DataError(
            f"{where} announces {n_edges} edges after its {len(positions)} scans, but has "
            f"{length - position - _COUNT.size} bytes there; it is damaged, so fetch it again."
        )
    return positions


def _read_points(file: io.BufferedIOBase, position: int, where: str) -> np.ndarray:
    """Points (N, 3), sensor frame (m), of the node at a byte position."""
    n_bytes = _count(file, position, where) * _POINT.itemsize
    points = np.frombuffer(file.read(n_bytes), _POINT)
    if not (points["length"] == 3).all():
        raise DataError(f"{where} has points that are not three numbers; the file is damaged.")
    return points["values"].astype(np.float64)


def _read_pose(file: io.BufferedIOBase, position: int, where: str) -> Tensor:
    """Pose (4, 4), world ← sensor, of the node at a byte position."""
    length = file.seek(0, io.SEEK_END)
    x, y, z, *quaternion = _pose_numbers(file, position, length, where)
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) < _NORM_ERROR:
        raise DataError(f"{where}: the quaternion {quaternion} has length {norm:.3g} instead of 1.")
    if not all(map(math.isfinite, (x, y, z))):
        raise DataError(f"{where} is not a rigid pose: its position {[x, y, z]} is not finite.")
    w, *axis = quaternion
    return Pose.from_quaternion([x, y, z], [*axis, w]).matrix


def _count(file: io.BufferedIOBase, position: int, where: str) -> int:
    file.seek(position)
    data = file.read(_COUNT.size)
    if len(data) < _COUNT.size:
        raise DataError(f"{where} ends where a count is expected; it is cut off, so fetch it again.")
    return int(_COUNT.unpack(data)[0])


def _pose_numbers(file: io.BufferedIOBase, position: int, length: int, where: str) -> list[float]:
    """x, y, z, w, x, y, z of the pose of the node at a byte position in a file of `length` bytes."""
    n_points = _count(file, position, where)
    if position + _NODE_BYTES + n_points * _POINT.itemsize > length:
        raise DataError(
            f"{where} announces {n_points} points, which the file is too short for; it is cut off, or not a "
            "scan graph of OctoMap."
        )
    file.seek(position + _COUNT.size + n_points * _POINT.itemsize)
    three, x, y, z, four, *quaternion = _POSE.unpack(file.read(_POSE.size))
    if (three, four) != (3, 4):
        raise DataError(f"{where} has no pose where one is expected; this is not a scan graph of OctoMap.")
    return [x, y, z, *quaternion]
