"""Fields of several messages in a bit stream: sets of ids and keys, intervals, numbers and rigid motions."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.linalg import check_rigid
from gmmtorch.mapping import BitReader, BitWriter, Ints
from gmmtorch.team.sharing.messages.envelope import FARTHEST, LARGEST_NUMBER
from gmmtorch.team.sharing.replica.record_keys import END, MOST_RECORDS, NUMBER_BITS, Intervals, authors

_LEAST_BITS = 8  # of a number in the stream
_NUMBERS = {2: 4, 3: 7}
"""Numbers of a rigid motion: in 2D a translation with cos and sin of the yaw; in 3D a translation with a unit
quaternion x, y, z, w; metres."""
_UNIT = 1e-9


def check_ids(name: str, ids: Tensor) -> Tensor:
    """The ids (J, 2); raises `InvalidArgumentError` unless they are int64, in range and distinct."""
    if ids.shape[1:] != (2,) or ids.dtype != torch.int64:
        raise InvalidArgumentError(f"{name} is {tuple(ids.shape)} of {ids.dtype}; expected (J, 2) of int64.")
    if len(ids) and not (int(ids.min()) >= 0 and int(ids.max()) <= LARGEST_NUMBER):
        raise InvalidArgumentError(
            f"{name} reach from {int(ids.min())} to {int(ids.max())}; robots and numbers go from 0 to "
            f"{LARGEST_NUMBER}."
        )
    if len(torch.unique(ids, dim=0)) != len(ids):
        raise InvalidArgumentError(f"{name} holds the same (robot, number) twice; give each once.")
    return ids


def id_order(ids: Tensor) -> Ints:
    """The order (J,) that sorts ids by robot, then by number."""
    return np.lexsort((ids[:, 1].cpu().numpy(), ids[:, 0].cpu().numpy()))


def write_ids(writer: BitWriter, ids: Ints) -> None:
    """Write distinct ids (J, 2) in `id_order`: for each robot their number, the first, and the gaps between
    them."""
    robots, first, n_each = np.unique(ids[:, 0], return_index=True, return_counts=True)
    writer.number(len(robots))
    for robot, begin, n in zip(robots.tolist(), first.tolist(), n_each.tolist(), strict=True):
        numbers = ids[begin : begin + n, 1]
        writer.number(robot)
        writer.number(n)
        writer.number(int(numbers[0]))
        if n > 1:
            writer.rice_column(np.diff(numbers) - 1)


def read_ids(reader: BitReader) -> Ints:
    """Ids (J, 2). Each but a robot's first takes at least one bit, so the data bound the memory."""
    n_robots = reader.number()
    parts, last = [np.zeros((0, 2), np.int64)], -1
    if n_robots < 0:
        raise DataError(f"{n_robots} robots: it is damaged.")
    reader.require(3 * 8 * n_robots)
    for _ in range(n_robots):
        robot, n, first = reader.number(), reader.number(), reader.number()
        if not (last < robot <= LARGEST_NUMBER and n >= 1 and first >= 0):
            raise DataError(f"Robot {robot} after {last} with {n} ids from {first} on: it is damaged.")
        gaps = reader.rice_column(n - 1) if n > 1 else np.zeros(0, np.int64)
        about = first + n + float(gaps.astype(np.float64).sum())  # the exact sum could overflow
        if about > 2 * LARGEST_NUMBER or first + n - 1 + int(gaps.sum()) > LARGEST_NUMBER:
            raise DataError("Ids are out of range: it is damaged.")
        numbers = first + np.cumsum(np.concatenate([np.zeros(1, np.int64), gaps + 1]))
        parts.append(np.stack([np.full(n, robot), numbers], 1))
        last = robot
    return np.concatenate(parts)


def write_keys(writer: BitWriter, keys: Ints) -> None:
    """Write distinct, rising keys (J,) of records, as ids of authors, whose keys are far apart."""
    write_ids(writer, np.stack([authors(keys), keys & (MOST_RECORDS - 1)], 1))


def read_keys(reader: BitReader) -> Ints:
    """Keys (J,), rising; memory is bounded as in `read_ids`."""
    names = read_ids(reader)
    if len(names) and (
        int(names[:, 0].max()) >= END >> NUMBER_BITS or int(names[:, 1].max()) >= MOST_RECORDS
    ):
        raise DataError("Keys of records are out of range: it is damaged.")
    return names[:, 0] << NUMBER_BITS | names[:, 1]


def write_intervals(writer: BitWriter, intervals: Intervals, begin: int) -> None:
    """Write their number; for each the gap before it, from `begin` or the last end, and its length less
    one."""
    writer.number(len(intervals))
    for first, end in intervals.pairs():
        writer.number(first - begin)
        writer.number(end - first - 1)
        begin = end


def read_intervals(reader: BitReader, begin: int, end: int) -> Intervals:
    """Intervals of numbers from `begin` to `end` − 1."""
    n = reader.number()
    if n < 0:
        raise DataError(f"{n} intervals: it is damaged.")
    reader.require(2 * _LEAST_BITS * n)
    edges = [begin]
    for _ in range(n):
        gap, length = reader.number(), reader.number() + 1
        if gap < (len(edges) > 1) or length < 1 or edges[-1] + gap + length > end:
            raise DataError("Intervals touch, are empty, or are out of range: it is damaged.")
        edges += [edges[-1] + gap, edges[-1] + gap + length]
    return Intervals(np.array(edges[1:], np.int64))


def write_number(writer: BitWriter, name: str, value: int) -> None:
    """Write a robot id, or another whole number ≥ 0."""
    writer.number(check_whole(name, value, 0, LARGEST_NUMBER))


def read_number(reader: BitReader) -> int:
    """A robot id, or another whole number ≥ 0."""
    value = reader.number()
    if not 0 <= value <= LARGEST_NUMBER:
        raise DataError(f"A number is {value}, not from 0 to {LARGEST_NUMBER}: it is damaged.")
    return value


def motion_dim(pose: Tensor) -> int:
    """2 or 3."""
    return {n: dim for dim, n in _NUMBERS.items()}[len(pose)]


def is_motion(pose: Tensor) -> bool:
    """Whether it is a valid pose."""
    for dim, n in _NUMBERS.items():
        if pose.shape == (n,):
            near = bool((pose[:dim].abs() <= FARTHEST).all())
            return near and abs(float(pose[dim:].norm()) - 1) <= _UNIT
    return False


def pose_of(transform: Tensor) -> Tensor:
    """The pose of a rigid motion (3, 3) or (4, 4).

    Raises `InvalidArgumentError` if it is not rigid or moves too far.
    """
    if transform.shape not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(f"transform has shape {tuple(transform.shape)}; give (3, 3) or (4, 4).")
    rotation, translation = check_rigid(transform.detach().cpu().double(), len(transform) - 1)
    if not bool((translation.abs() <= FARTHEST).all()):
        raise InvalidArgumentError(f"transform moves by {translation.tolist()}; {FARTHEST:g} m is the most.")
    if len(rotation) == 2:
        turn = rotation[:, 0] / rotation[:, 0].norm()
    else:
        from scipy.spatial.transform import Rotation

        turn = torch.from_numpy(Rotation.from_matrix(rotation.numpy()).as_quat(canonical=True))
    return torch.cat([translation, turn]) + 0.0  # no −0


def matrix_of(pose: Tensor) -> Tensor:
    """The motion (D+1, D+1) of a pose."""
    dim = motion_dim(pose)
    matrix = torch.eye(dim + 1, dtype=torch.float64)
    matrix[:-1, -1] = pose[:dim]
    if dim == 2:
        cos, sin = pose[2:].tolist()
        turn = torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64)
    else:
        from scipy.spatial.transform import Rotation

        turn = torch.from_numpy(Rotation.from_quat(pose[3:].numpy()).as_matrix())
    matrix[:-1, :-1] = turn
    return matrix


def write_motion(writer: BitWriter, pose: Tensor) -> None:
    """A bit for the dimension, then the numbers of a valid pose as float64."""
    writer.one(int(motion_dim(pose) == 3), 1)
    writer.fixed(pose.numpy().astype("<f8").view("<u4").astype(np.int64), 32)


def read_motion(reader: BitReader) -> Tensor:
    """What `write_motion` wrote; it may be no valid pose."""
    halves = reader.fixed(2 * _NUMBERS[2 + reader.one(1)], 32)
    return torch.from_numpy(halves.astype("<u4").view("<f8").astype(np.float64))
