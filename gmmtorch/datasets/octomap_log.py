"""Scan graphs of OctoMap: text logs, the format of the Freiburg campus scans, and binary `.graph` files.

In a text log, a line `NODE x y z roll pitch yaw` (metres, radians; R = Rz(yaw) Ry(pitch) Rx(roll), world ←
sensor) starts a scan. The lines up to the next NODE are its points in the sensor frame, three numbers each.
Blank lines and comments (#) are skipped. The binary format is in `scan_graph`.
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import torch

from gmmtorch.datasets import scan_graph
from gmmtorch.datasets.base import Dataset, Ranges, gunzip, require_path
from gmmtorch.errors import DataError
from gmmtorch.scan import Scan

_LINE_BYTES = 1 << 12


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
            self._is_binary = scan_graph.is_scan_graph(file)
            file.seek(0)
            if self._is_binary:
                self._nodes = scan_graph.node_positions(file, str(self._path))
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
        pose, points = self._known_pose(index), self._points(index)
        return self.ranges.scan(points @ pose[:3, :3].T + pose[:3, 3], pose[:3, 3])

    def _points(self, index: int) -> torch.Tensor:
        """Points (N, 3) of a scan, sensor frame."""
        where = f"{self._path}, scan {index}"
        if self._is_binary:
            with self._open() as file:
                return torch.from_numpy(scan_graph.read_points(file, self._nodes[index], where))
        stop = self._nodes[index + 1] if index + 1 < len(self._nodes) else None
        with self._open() as file:
            file.seek(self._nodes[index])
            text = file.read() if stop is None else file.read(stop - self._nodes[index])
        _, *lines = text.decode("ascii", errors="replace").splitlines()
        lines = [line for line in lines if line.strip() and not line.startswith("#")]
        return torch.from_numpy(_numbers(lines, 3, where))

    def _known_pose(self, index: int) -> torch.Tensor:
        where = f"{self._path}, scan {index}"
        with self._open() as file:
            if self._is_binary:
                return scan_graph.read_pose(file, self._nodes[index], where)
            file.seek(self._nodes[index])
            head = file.readline(_LINE_BYTES).decode("ascii", errors="replace")
        return _node_pose(head, where)


def _node_pose(line: str, where: str) -> torch.Tensor:
    """The pose (4, 4) in a NODE line."""
    numbers = _numbers([line.removeprefix("NODE")], 6, where + ", NODE line")[0]
    if not np.isfinite(numbers).all():
        raise DataError(f"{where}: the pose {numbers.tolist()} is not finite.")
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = rotation(*numbers[3:]), torch.from_numpy(numbers[:3])
    return pose


def rotation(roll: float, pitch: float, yaw: float) -> torch.Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3), from angles in radians."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix())


def _node_positions(file: io.BufferedIOBase) -> list[int]:
    """Byte positions of the NODE lines in the file."""
    positions, position = [], 0
    for line in file:
        if line.startswith(b"NODE"):
            positions.append(position)
        position += len(line)
    return positions


def _numbers(lines: list[str], columns: int, where: str) -> np.ndarray:
    try:
        table = np.array([line.split() for line in lines], dtype=np.float64)
    except ValueError as error:
        raise DataError(f"{where}: expected {columns} numbers a line ({error}).") from error
    if not lines:
        return np.empty((0, columns))
    if table.ndim != 2 or table.shape[1] != columns:
        raise DataError(f"{where}: expected {columns} numbers a line, found {table.shape[-1]}.")
    return table
