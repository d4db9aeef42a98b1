"""Points of a frame, views worth visiting, and the plan of a robot, as datagrams. See docs/messages.md."""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.mapping import BitReader, BitWriter, Ints, unzigzag, zigzag
from gmmtorch.team.sharing.messages.datagrams import (
    FARTHEST,
    LARGEST_NUMBER,
    MAX_BYTES,
    Kind,
    check_ids,
    check_places,
    make_datagram,
    read_intervals,
    read_keys,
    split,
    write_intervals,
    write_keys,
)
from gmmtorch.team.sharing.replica.record_keys import END, Intervals, ids_of, keys_of

_HEADER = struct.Struct("<HI3dHHH")  # sender, frame, origin, part, parts, points
_POINT_BYTES = 12
_OVERHEAD = len(make_datagram(Kind.POINTS, b""))
POINTS_PER_DATAGRAM = (MAX_BYTES - _OVERHEAD - _HEADER.size) * 8 // (8 * _POINT_BYTES + 1)
LARGEST_ROBOT, LARGEST_FRAME, MOST_PARTS = (1 << 16) - 1, (1 << 32) - 1, (1 << 16) - 1


@dataclass(frozen=True, eq=False)
class PointsMessage:
    """Part `part` of `n_parts` of the novel beams of a robot's frame. origin (3,) of all beams, ends (N, 3),
    float64, metres, world frame; is_hit (N,) bool: the others are no-return beams, which end at the range
    where they are cut off."""

    sender: int
    frame: int
    part: int
    n_parts: int
    origin: Tensor
    ends: Tensor
    is_hit: Tensor


def encode_points(sender: int, frame: int, origin: Tensor, ends: Tensor, is_hit: Tensor) -> list[bytes]:
    """Datagrams of beams in order, 12 1/8 bytes each; empty without beams.

    Ends are stored as float32 offsets from the origin, so that they are equally exact anywhere in the world.

    sender: id of the robot, up to 65535. frame: its number, up to 2³² − 1. origin: (3,), metres. ends: (N,
    3), metres. is_hit: (N,) bool.

    Raises `InvalidArgumentError` for values out of range, and for positions beyond `datagrams.FARTHEST`.
    """
    check_whole("sender", sender, 0, LARGEST_ROBOT)
    check_whole("frame", frame, 0, LARGEST_FRAME)
    if ends.shape[1:] != (3,) or origin.shape != (3,) or is_hit.shape != ends.shape[:1]:
        raise InvalidArgumentError(
            f"origin {tuple(origin.shape)}, ends {tuple(ends.shape)} and is_hit {tuple(is_hit.shape)} must "
            "be (3,), (N, 3) and (N,)."
        )
    place = origin.detach().double().cpu()
    check_places("origin", place[None])
    rounded = (ends.detach().double().cpu() - place).float()
    check_places("ends", place + rounded.double())
    offsets = rounded.numpy()
    hits = is_hit.cpu().numpy().astype(bool)
    starts = range(0, len(offsets), POINTS_PER_DATAGRAM)
    if len(starts) > MOST_PARTS:
        raise InvalidArgumentError(
            f"{len(offsets)} points of one frame; at most {MOST_PARTS * POINTS_PER_DATAGRAM} can be sent."
        )
    datagrams = []
    for part, begin in enumerate(starts):
        chosen = slice(begin, begin + POINTS_PER_DATAGRAM)
        rows, bits = offsets[chosen], np.packbits(hits[chosen])
        header = _HEADER.pack(sender, frame, *place.tolist(), part, len(starts), len(rows))
        datagrams.append(make_datagram(Kind.POINTS, header + rows.astype("<f4").tobytes() + bits.tobytes()))
    return datagrams


def read_points(body: bytes) -> PointsMessage:
    if len(body) < _HEADER.size:
        raise DataError(f"{len(body)} bytes are too few for points.")
    sender, frame, x, y, z, part, n_parts, n = _HEADER.unpack_from(body)
    if len(body) != _HEADER.size + _POINT_BYTES * n + (n + 7) // 8 or not part < n_parts or n == 0:
        raise DataError(f"{len(body)} bytes with {n} points, part {part} of {n_parts}: it is damaged.")
    offsets = np.frombuffer(body, "<f4", 3 * n, _HEADER.size).reshape(n, 3)
    bits = np.unpackbits(np.frombuffer(body, np.uint8, offset=_HEADER.size + _POINT_BYTES * n))
    if bits[n:].any() or not np.isfinite(offsets).all():
        raise DataError("Points are NaN or infinite, or padding bits are set: it is damaged.")
    offsets = offsets.astype(np.float64)  # after the check, as casting some NaNs raises a warning
    origin = torch.tensor([x, y, z], dtype=torch.float64)
    check_places("origin", origin[None])
    ends = check_places("ends", origin + torch.from_numpy(offsets))
    return PointsMessage(sender, frame, part, n_parts, origin, ends, torch.from_numpy(bits[:n] != 0))


MOST_POSES = 1000
"""Poses of a path, and of the views of a plan: those of a robot at rest take no bits that bound them."""
STEPS_PER_METRE = 100
"""Positions are whole centimetres."""
YAW_STEPS = 256
"""Steps of a full turn."""
VIEW_YAW_STEPS = 32
"""Those of views, whose positions are whole decimetres, because their information is that of the nearest pose
of a coarser lattice, and a robot that comes near has visited them."""
_YAW_BITS = 8
_COARSER = np.array([10] * 3 + [YAW_STEPS // VIEW_YAW_STEPS])
TICKS, STAMP_TICKS = 1000, 1
"""Times of plans are whole milliseconds; stamps of views are whole seconds."""
LATEST = 1e9
"""Latest time (s)."""
_HEADER_NUMBERS, _HEADER_BITS = 6, 2  # of a plan, and low bits of their code: most are small
_FARTHEST_STEP = FARTHEST * STEPS_PER_METRE
_VALUE_SHIFT = 7  # lowest bits of a float16 that values of views leave out: they are rounded by up to 6 %
_LARGEST_VALUE = 0x7BFF  # the bits of the largest float16


@dataclass(frozen=True, eq=False)
class ViewsMessage:
    """Views that are new or changed, and the keys of views that are removed.

    ids (V, 2): (robot, sequence), as of records; poses (V, 4); values (V,); stamps (V,) s, when the value was
    found. removed: keys, as in `record_keys`.
    """

    ids: Tensor
    poses: Tensor
    values: Tensor
    stamps: Tensor
    removed: Intervals


@dataclass(frozen=True, eq=False)
class PlanMessage:
    """Plan number `number` of robot `sender`.

    path (S, 4): poses at time, time + step, time + 2 step, … (s); the robot is at rest at the last one.
    views (V, 4): camera poses that the robot will observe from, rounded as `quantized_views` does.
    """

    sender: int
    number: int
    time: float
    step: float
    path: Tensor
    views: Tensor


def encode_views(message: ViewsMessage) -> list[bytes]:
    """Datagrams of views, 5 to 7 bytes each, and of removed keys; empty without either. Ids in any order.

    Poses are rounded to 10 cm and 1/32 of a turn (`quantized_views`), values to four significant bits
    (`quantized_values`), stamps to 1 s. Raises `InvalidArgumentError` for values that are not finite, for
    duplicate ids, and for rows of different lengths.
    """
    m = message
    sizes = (len(m.poses), len(m.values), len(m.stamps))
    if sizes != (len(m.ids),) * 3:
        raise InvalidArgumentError(
            f"{len(m.ids)} ids with {sizes[0]} poses, {sizes[1]} values and {sizes[2]} stamps: each id "
            "needs one of each."
        )
    if not Intervals.span(0, END).covers(m.removed):
        raise InvalidArgumentError(f"removed={m.removed!r} goes beyond the largest key, {END - 1}.")
    try:
        keys = keys_of(check_ids("ids", m.ids))
    except DataError as error:
        raise InvalidArgumentError(f"ids: {error}") from error
    order, removed = np.argsort(keys), m.removed
    keys = keys[order]
    steps = _coarse(_pose_steps("poses", m.poses))[order]
    values = _value_steps(m.values.detach().double().cpu().numpy())[order]
    times = _ticks("stamps", m.stamps, STAMP_TICKS)[order]

    def part(begin: int, end: int) -> bytes:
        """Items begin … end − 1 of all views, followed by all intervals of removed keys."""
        views = slice(min(begin, len(keys)), min(end, len(keys)))
        edges = slice(2 * max(begin - len(keys), 0), 2 * max(end - len(keys), 0))
        writer = BitWriter()
        write_keys(writer, keys[views])
        _write_views(writer, steps[views])
        writer.column(values[views])
        writer.column(times[views])
        write_intervals(writer, Intervals(removed.edges[edges]), 0)
        return make_datagram(Kind.VIEWS, writer.to_bytes())

    return split(len(keys) + len(removed), part, "view")


def read_views(body: bytes) -> ViewsMessage:
    reader = BitReader(body)
    keys = read_keys(reader)
    poses = _read_views(reader, len(keys))
    values = reader.column(len(keys))
    if len(values) and int(np.abs(values).max()) > _LARGEST_VALUE >> _VALUE_SHIFT:
        raise DataError("Values are NaN or infinite: it is damaged.")
    stamps = _seconds_of(reader.column(len(keys)), STAMP_TICKS)
    removed = read_intervals(reader, 0, END)
    reader.finish()
    return ViewsMessage(ids_of(keys), poses, torch.from_numpy(_values(values)), stamps, removed)


def encode_plan(
    sender: int, number: int, time: float, step: float, path: Tensor, views: Tensor | None = None
) -> list[bytes]:
    """The datagram of a plan, 1 to 3 bytes per pose of the path, 2 to 3 a view.

    Poses are rounded to 1 cm and 1/256 of a turn, views to 10 cm and 1/32 of a turn, times to 1 ms.

    sender: id of the robot. number: rises with each of its plans. time: (s) of the first pose of the path; it
    takes least bytes if the plans before took as long as this one and began at 0.
    step: (s) from each pose to the next, above zero. path: (S, 4). views: (V, 4).

    Raises `InvalidArgumentError` if the plan does not fit into a datagram.
    """
    for name, value in (("sender", sender), ("number", number)):
        check_whole(name, value, 0, LARGEST_NUMBER)
    start, pace = (
        int(_ticks(name, torch.tensor([value], dtype=torch.float64))[0])
        for name, value in (("time", time), ("step", step))
    )
    if pace < 1:
        raise InvalidArgumentError(f"step={step} must be at least a millisecond.")
    views = path[:0] if views is None else views
    for name, poses in (("path", path), ("views", views)):
        if len(poses) > MOST_POSES:
            raise InvalidArgumentError(f"{name} has {len(poses)} poses; {MOST_POSES} are the most.")
    late = start - _expected(number, pace, len(path))
    header = np.array([sender, len(path), len(views), late, number, pace])
    header[3:4] = zigzag(header[3:4])
    writer = BitWriter()
    writer.golomb(header, _HEADER_BITS)
    last = _write_path(writer, _pose_steps("path", path))
    seen = _coarse(np.concatenate([last, _pose_steps("views", views)]))
    _write_moves(writer, _moves(seen, VIEW_YAW_STEPS), _OF_VIEWS)
    datagram = make_datagram(Kind.PLAN, writer.to_bytes())
    if len(datagram) > MAX_BYTES:
        raise InvalidArgumentError(
            f"The plan of {len(path)} poses takes {len(datagram)} bytes; a datagram has room for "
            f"{MAX_BYTES}. Send every second pose, or fewer."
        )
    return [datagram]


def read_plan(body: bytes) -> PlanMessage:
    reader = BitReader(body)
    header = reader.golomb(_HEADER_NUMBERS, _HEADER_BITS)
    sender, n_path, n_views, _, number, pace = header.tolist()
    if max(sender, number) > LARGEST_NUMBER:
        raise DataError(f"Plan {number} of robot {sender}: {LARGEST_NUMBER} is the most. It is damaged.")
    if max(n_path, n_views) > MOST_POSES:
        raise DataError(f"{n_path} poses, {n_views} views; {MOST_POSES} are the most: it is damaged.")
    if not 0 < pace <= LATEST * TICKS:
        raise DataError(f"The poses of a path are {pace} ms apart: it is damaged.")
    start = int(unzigzag(header[3:4])[0]) + _expected(number, pace, n_path)
    if abs(start) > LATEST * TICKS:
        raise DataError(f"A plan begins after {start} ms: it is damaged.")
    path = _read_path(reader, n_path)
    last = _coarse(path[-1:] if n_path else np.zeros((1, 4), np.int64))
    views = (last + np.cumsum(_read_moves(reader, n_views, _OF_VIEWS), 0)) * _COARSER
    reader.finish()
    seconds = start / TICKS, pace / TICKS
    return PlanMessage(sender, number, *seconds, _checked_poses(path), _checked_poses(views))


def _expected(number: int, pace: int, n_poses: int) -> int:
    """When a plan begins (ms) if those before it took as long, and the first one began at 0."""
    expected = number * pace * n_poses
    return expected if expected <= LATEST * TICKS else 0


def quantized_values(values: Tensor) -> Tensor:
    """Values (V,) of views as messages round them: to four significant bits, so by up to 6 %."""
    return torch.from_numpy(_values(_value_steps(values.detach().double().cpu().numpy())))


def quantized_value(value: float) -> float:
    """A value as `quantized_values` rounds it."""
    return float(_values(_value_steps(np.array([value])))[0])


def _value_steps(rows: NDArray[np.float64]) -> Ints:
    """The highest bits (V,) of values as float16, rounded, with their sign."""
    if rows.ndim != 1 or not (np.abs(rows) <= np.finfo(np.float16).max).all():
        raise InvalidArgumentError("values must be a row of numbers up to 65504, the most of float16.")
    halves = np.abs(rows).astype(np.float16).view(np.uint16).astype(np.int64)
    half_step = 1 << (_VALUE_SHIFT - 1)
    size = np.minimum((halves + half_step) >> _VALUE_SHIFT, _LARGEST_VALUE >> _VALUE_SHIFT)
    return np.where(rows < 0, -size, size)


def _values(steps: Ints) -> NDArray[np.float64]:
    size = (np.abs(steps) << _VALUE_SHIFT).astype(np.uint16).view(np.float16).astype(np.float64)
    return np.where(steps < 0, -size, size)


def quantized_poses(poses: Tensor) -> Tensor:
    """Poses (N, 4) of a path as plans round them: to 1 cm and 1/256 of a turn, yaw in [−π, π)."""
    return _poses(_pose_steps("poses", poses))


def quantized_views(poses: Tensor) -> Tensor:
    """Views (N, 4) as messages round them: to 10 cm and 1/32 of a turn, yaw in [−π, π)."""
    return _poses(_coarse(_pose_steps("views", poses)) * _COARSER)


def _coarse(steps: Ints) -> Ints:
    """Poses (N, 4) in the steps of views."""
    rounded: Ints = np.rint(steps / _COARSER).astype(np.int64)
    rounded[:, 3] %= VIEW_YAW_STEPS
    return rounded


def _pose_steps(name: str, poses: Tensor) -> Ints:
    """Poses (N, 4) in steps, yaw from 0 to 255."""
    if poses.ndim != 2 or poses.shape[1] != 4:
        raise InvalidArgumentError(f"{name} has shape {tuple(poses.shape)}; expected (N, 4): x, y, z, yaw.")
    rows = poses.detach().double().cpu().numpy()
    good = (np.abs(rows[:, :3]) <= FARTHEST).all(1) & np.isfinite(rows[:, 3])
    if not good.all():
        first = int(good.argmin())
        raise InvalidArgumentError(
            f"{name}[{first}] is {rows[first].tolist()}; positions reach {FARTHEST:g} m, and yaw is finite."
        )
    scaled = rows * np.array([STEPS_PER_METRE] * 3 + [YAW_STEPS / (2 * math.pi)])
    scaled[:, 3] %= YAW_STEPS
    steps: Ints = np.rint(scaled).astype(np.int64)
    steps[:, 3] %= YAW_STEPS
    return steps


def _write_views(writer: BitWriter, steps: Ints) -> None:
    """Write unrelated views (N, 4), in steps of views, as four columns."""
    for axis in range(4 if len(steps) else 0):
        writer.column(steps[:, axis])


def _read_views(reader: BitReader, n: int) -> Tensor:
    """Views (n, 4). Columns may take no bits at all, so the caller must bound n."""
    steps = np.zeros((n, 4), np.int64)
    for axis in range(4 if n else 0):
        steps[:, axis] = reader.column(n)
    farthest = int(_FARTHEST_STEP)
    return _checked_poses(steps.clip(-farthest, farthest) * _COARSER)  # which does not overflow


def _write_path(writer: BitWriter, steps: Ints) -> Ints:
    """Write poses (S, 4) of a path: the first pose, the first move, then how each move differs from the one
    before, which is little. Returns the last pose (1, 4); zeros, if there is none."""
    if not len(steps):
        return np.zeros((1, 4), np.int64)
    for value in steps[0, :3].tolist():
        writer.number(value)
    writer.one(int(steps[0, 3]), _YAW_BITS)
    moves = _moves(steps)
    _write_moves(writer, moves[:1], _OF_FIRST)
    _write_moves(writer, np.diff(moves, axis=0), _OF_LATER)
    return steps[-1:]


def _read_path(reader: BitReader, n: int) -> Ints:
    """Poses (n, 4) of a path, in steps."""
    if not n:
        return np.zeros((0, 4), np.int64)
    first = np.array([[*(reader.number() for _ in range(3)), reader.one(_YAW_BITS)]], np.int64)
    begin = _read_moves(reader, min(n - 1, 1), _OF_FIRST)
    moves = np.cumsum(np.concatenate([begin, _read_moves(reader, max(n - 2, 0), _OF_LATER)]), 0)
    return np.concatenate([first, first + np.cumsum(moves, 0)])


def _moves(steps: Ints, turn: int = YAW_STEPS) -> Ints:
    """The moves (S − 1, 4) from each of poses (S, 4) to the next; the yaw, of `turn` steps, takes the shorter
    way round."""
    moves = np.diff(steps, axis=0)
    moves[:, 3] = (moves[:, 3] + turn // 2) % turn - turn // 2
    return moves


_AXES = slice(0, 2), slice(2, 4)
"""Moves along x and y are of one size, those along z and turns of another."""
_OF_FIRST, _OF_LATER, _OF_VIEWS = (4, 3), (2, 0), (3, 1)
"""Low bits of their codes: of a path's first move, of the differences of later ones, of moves to views."""


def _write_moves(writer: BitWriter, moves: Ints, lows: tuple[int, int]) -> None:
    for axes, low in zip(_AXES, lows, strict=True):
        writer.golomb(zigzag(moves[:, axes].reshape(-1)), low)


def _read_moves(reader: BitReader, n: int, lows: tuple[int, int]) -> Ints:
    """Moves (n, 4), of at least a bit for each number, so the data bound the memory."""
    moves = np.zeros((n, 4), np.int64)
    for axes, low in zip(_AXES, lows, strict=True):
        moves[:, axes] = unzigzag(reader.golomb(2 * n, low)).reshape(n, 2)
    if n and int(np.abs(moves).max()) > 4 * _FARTHEST_STEP:
        raise DataError("A path leaves the world: it is damaged.")
    return moves


def _ticks(name: str, seconds: Tensor, ticks: int = TICKS) -> Ints:
    """Times (N,) in ticks, so many a second, of times in seconds."""
    times = seconds.detach().double().cpu().numpy()
    if times.ndim != 1 or not (np.abs(times) <= LATEST).all():
        raise InvalidArgumentError(f"{name} must be a row of times (s) of at most {LATEST:g}, and finite.")
    return np.rint(times * ticks).astype(np.int64)


def _seconds_of(steps: Ints, ticks: int = TICKS) -> Tensor:
    """Times (N,) in seconds, of times in ticks, so many a second."""
    if len(steps) and int(np.abs(steps).max()) > LATEST * ticks:
        raise DataError(f"Times are later than {LATEST:g} s: it is damaged.")
    return torch.from_numpy(steps.astype(np.float64) / ticks)


def _checked_poses(steps: Ints) -> Tensor:
    if len(steps) and int(np.abs(steps[:, :3]).max()) > _FARTHEST_STEP:
        raise DataError(f"Positions lie farther out than {FARTHEST:g} m: it is damaged.")
    return _poses(steps)


def _poses(steps: Ints) -> Tensor:
    positions = steps[:, :3].astype(np.float64) / STEPS_PER_METRE
    half = YAW_STEPS // 2
    yaw = ((steps[:, 3] + half) % YAW_STEPS - half) * (2 * math.pi / YAW_STEPS)
    return torch.from_numpy(np.concatenate([positions, yaw[:, None]], 1))
