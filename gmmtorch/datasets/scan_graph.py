"""Binary scan graphs of OctoMap (`.graph`): scans with poses, little endian.

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

import numpy as np
import torch
from torch import Tensor

from gmmtorch.datasets.base import check_pose
from gmmtorch.errors import DataError

_COUNT = struct.Struct("<I")
_POINT = np.dtype([("length", "<i4"), ("values", "<f8", 3)])
_POSE = struct.Struct("<i3di4d")
_NODE_BYTES = 2 * _COUNT.size + _POSE.size  # of a node without points
_EDGE_BYTES = 2 * _COUNT.size + _POSE.size + 8
_NORM_ERROR = 1e-2


def is_scan_graph(file: io.BufferedIOBase) -> bool:
    """Whether the file is binary: a text log has no zero byte, the first counts of a graph have some."""
    file.seek(0)
    return b"\0" in file.read(2 * _COUNT.size)


def node_positions(file: io.BufferedIOBase, where: str) -> list[int]:
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


def read_points(file: io.BufferedIOBase, position: int, where: str) -> np.ndarray:
    """Points (N, 3), sensor frame (m), of the node at a byte position."""
    n_bytes = _count(file, position, where) * _POINT.itemsize
    points = np.frombuffer(file.read(n_bytes), _POINT)
    if not (points["length"] == 3).all():
        raise DataError(f"{where} has points that are not three numbers; the file is damaged.")
    return points["values"].astype(np.float64)


def read_pose(file: io.BufferedIOBase, position: int, where: str) -> Tensor:
    """Pose (4, 4), world ← sensor, of the node at a byte position."""
    from scipy.spatial.transform import Rotation

    length = file.seek(0, io.SEEK_END)
    x, y, z, *quaternion = _pose_numbers(file, position, length, where)
    norm = math.hypot(*quaternion)
    if not abs(norm - 1) < _NORM_ERROR:
        raise DataError(f"{where}: the quaternion {quaternion} has length {norm:.3g} instead of 1.")
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.from_numpy(Rotation.from_quat(quaternion, scalar_first=True).as_matrix())
    pose[:3, 3] = torch.tensor([x, y, z], dtype=torch.float64)
    return check_pose(pose, where)


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
