"""Fields of several messages in a bit stream: sets of ids and keys, intervals, poses and times."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.mapping.codec.bitstream import BitReader, BitWriter, Ints
from gmmtorch.sharing.messages.envelope import FARTHEST
from gmmtorch.sharing.replica.record_keys import END, MOST_RECORDS, NUMBER_BITS, Intervals, authors

LARGEST_NUMBER = (1 << 60) - 1
"""Largest robot id, and largest number of anything that a robot counts."""
STEPS_PER_METRE = 100
"""Positions are whole centimetres."""
YAW_STEPS = 256
"""Steps of a full turn."""
TICKS = 1000
"""Times are whole milliseconds."""
LATEST = 1e9
"""Latest time (s)."""
_LEAST_BITS = 8  # of a number in the stream
_FARTHEST_STEP = FARTHEST * STEPS_PER_METRE


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


def quantized_poses(poses: Tensor) -> Tensor:
    """Poses (N, 4) as messages round them: to 1 cm and 1/256 of a turn, yaw in [−π, π)."""
    return _poses(pose_steps("poses", poses))


def pose_steps(name: str, poses: Tensor) -> Ints:
    """Poses (N, 4) in steps, yaw from 0 to 255."""
    if poses.ndim != 2 or poses.shape[1] != 4:
        raise InvalidArgumentError(f"{name} has shape {tuple(poses.shape)}; expected (N, 4): x, y, z, yaw.")
    rows = poses.detach().double().cpu()
    bad = ~((rows[:, :3].abs() <= FARTHEST).all(1) & rows[:, 3].isfinite())
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"{name}[{first}] is {rows[first].tolist()}; positions reach {FARTHEST:g} m, and yaw is finite."
        )
    scaled = rows * rows.new_tensor([STEPS_PER_METRE] * 3 + [YAW_STEPS / (2 * math.pi)])
    scaled[:, 3] = scaled[:, 3].remainder(YAW_STEPS)
    steps = scaled.round().long().numpy()
    steps[:, 3] %= YAW_STEPS
    return steps


def write_poses(writer: BitWriter, steps: Ints) -> None:
    """Write unrelated poses (N, 4) as four columns."""
    for axis in range(4 if len(steps) else 0):
        writer.column(steps[:, axis])


def read_poses(reader: BitReader, n: int) -> Tensor:
    """Poses (n, 4). Columns may take no bits at all, so the caller must bound n."""
    steps = np.zeros((n, 4), np.int64)
    for axis in range(4 if n else 0):
        steps[:, axis] = reader.column(n)
    return _checked_poses(steps)


def write_path(writer: BitWriter, steps: Ints) -> None:
    """Write poses (S, 4) along a path: the first, then four columns of the steps from each pose to the next.

    At constant speed and turn rate the steps are nearly equal.
    """
    for axis in range(4 if len(steps) else 0):
        ways = np.diff(steps[:, axis])
        if axis == 3:  # the shorter direction
            ways = (ways + YAW_STEPS // 2) % YAW_STEPS - YAW_STEPS // 2
        writer.number(int(steps[0, axis]))
        writer.column(ways)


def read_path(reader: BitReader, n: int) -> Tensor:
    """Poses (n, 4) of a path. The caller must bound n, as in `read_poses`."""
    steps = np.zeros((n, 4), np.int64)
    for axis in range(4 if n else 0):
        ways = np.concatenate([np.array([reader.number()], np.int64), reader.column(n - 1)])
        if float(np.abs(ways.astype(np.float64)).sum()) > _FARTHEST_STEP * 2 * n:
            raise DataError("A path leaves the world: it is damaged.")
        steps[:, axis] = np.cumsum(ways)
    return _checked_poses(steps)


def ticks(name: str, seconds: Tensor) -> Ints:
    """Times (N,) in milliseconds, of times in seconds."""
    times = seconds.detach().double().cpu()
    if times.ndim != 1 or not bool((times.abs() <= LATEST).all()):
        raise InvalidArgumentError(f"{name} must be a row of times (s) of at most {LATEST:g}, and finite.")
    return (times * TICKS).round().long().numpy()


def seconds_of(steps: Ints) -> Tensor:
    """Times (N,) in seconds, of times in milliseconds."""
    if len(steps) and int(np.abs(steps).max()) > LATEST * TICKS:
        raise DataError(f"Times are later than {LATEST:g} s: it is damaged.")
    return torch.from_numpy(steps.astype(np.float64) / TICKS)


def write_number(writer: BitWriter, name: str, value: int) -> None:
    """Write a robot id, or another whole number ≥ 0."""
    writer.number(_check_number(name, value))


def read_number(reader: BitReader) -> int:
    """A robot id, or another whole number ≥ 0."""
    value = reader.number()
    if not 0 <= value <= LARGEST_NUMBER:
        raise DataError(f"A number is {value}, not from 0 to {LARGEST_NUMBER}: it is damaged.")
    return value


def check_places(name: str, places: Tensor, farthest: float = FARTHEST) -> Tensor:
    """The positions (N, D), m; raises `InvalidArgumentError` unless all coordinates are at most
    `farthest`."""
    bad = ~(places.abs() <= farthest).all(1)
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"{name}[{first}] is {places[first].tolist()}; positions must be finite, and up to "
            f"{farthest:g} m on each axis. Is it in metres, and the world's origin near?"
        )
    return places


def _check_number(name: str, value: int) -> int:
    if check_whole(name, value, 0) > LARGEST_NUMBER:
        raise InvalidArgumentError(f"{name}={value} must be at most {LARGEST_NUMBER}.")
    return int(value)


def _checked_poses(steps: Ints) -> Tensor:
    if len(steps) and int(np.abs(steps[:, :3]).max()) > _FARTHEST_STEP:
        raise DataError(f"Positions lie farther out than {FARTHEST:g} m: it is damaged.")
    return _poses(steps)


def _poses(steps: Ints) -> Tensor:
    positions = steps[:, :3].astype(np.float64) / STEPS_PER_METRE
    half = YAW_STEPS // 2
    yaw = ((steps[:, 3] + half) % YAW_STEPS - half) * (2 * math.pi / YAW_STEPS)
    return torch.from_numpy(np.concatenate([positions, yaw[:, None]], 1))
