"""OctoMap's text logs, in which the Freiburg campus scans are published.

`NODE x y z roll pitch yaw` (metres, radians: R = Rz(yaw) Ry(pitch) Rx(roll), world ← sensor) opens
a scan; the lines that follow, up to the next NODE, are its points in the sensor frame, three
numbers each; blank lines and comments (#) are passed over.
"""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path

import numpy as np
import torch

from gmmtorch.datasets.base import Dataset, Ranges, existing
from gmmtorch.errors import DataError
from gmmtorch.scan import Scan


class OctomapLog(Dataset):
    """Scans in the order of the file, read when asked for: only their positions in it are kept.

    No return: points at or beyond `max_range`. Invalid, dropped: NaN and infinite points, and
    points on the sensor itself. Gzip files are unpacked into memory, once.
    """

    def __init__(self, path: str | Path, ranges: Ranges, stride: int = 1) -> None:
        self._path = existing(
            path,
            "file",
            "an OctoMap scan log (NODE x y z roll pitch yaw, then points)",
            "The OctoMap 3D scan dataset of the University of Freiburg is published in this format.",
        )
        super().__init__(self._path.name.split(".")[0], ranges, stride)
        self._unpacked = _unpack(self._path)
        with self._open() as file:
            self._nodes = _node_positions(file)
        if not self._nodes:
            raise DataError(f"{self._path} has no NODE line, so it is not an OctoMap scan log.")

    def _open(self) -> io.BufferedIOBase:
        return self._path.open("rb") if self._unpacked is None else io.BytesIO(self._unpacked)

    def _count(self) -> int:
        return len(self._nodes)

    def _read(self, index: int) -> Scan:
        stop = self._nodes[index + 1] if index + 1 < len(self._nodes) else None
        with self._open() as file:
            file.seek(self._nodes[index])
            text = file.read() if stop is None else file.read(stop - self._nodes[index])
        where = f"{self._path}, scan {index}"
        head, *lines = text.decode("ascii", errors="replace").splitlines()
        pose = _numbers([head.removeprefix("NODE")], 6, where + ", NODE line")[0]
        if not np.isfinite(pose).all():
            raise DataError(f"{where}: the pose {pose.tolist()} is not finite.")
        points = _numbers([line for line in lines if line.strip() and not line.startswith("#")], 3, where)
        origin = torch.from_numpy(pose[:3])
        return self.ranges.scan(torch.from_numpy(points) @ rotation(*pose[3:]).T + origin, origin)


def rotation(roll: float, pitch: float, yaw: float) -> torch.Tensor:
    """R = Rz(yaw) Ry(pitch) Rx(roll), (3, 3), from angles in radians."""
    from scipy.spatial.transform import Rotation

    return torch.from_numpy(Rotation.from_euler("xyz", [roll, pitch, yaw]).as_matrix())


def _unpack(path: Path) -> bytes | None:
    """The text of a gzip file; None for a plain one."""
    with path.open("rb") as file:
        if file.peek(2)[:2] != b"\x1f\x8b":
            return None
        try:
            return gzip.decompress(file.read())
        except (EOFError, zlib.error, gzip.BadGzipFile) as error:
            raise DataError(f"{path} is not a whole gzip file ({error}); fetch it again.") from error


def _node_positions(file: io.BufferedIOBase) -> list[int]:
    """Where in the file the NODE lines begin, in bytes."""
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
