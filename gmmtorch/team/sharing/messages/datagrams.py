"""What datagrams have in common: first byte, checksum and limits; and the fields of several messages."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from enum import IntEnum

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_choice, check_whole
from gmmtorch.mapping import BitReader, BitWriter, Ints
from gmmtorch.pose import Pose
from gmmtorch.team.sharing.replica.record_keys import END, MOST_RECORDS, NUMBER_BITS, Intervals, authors

MAX_BYTES = 1200
"""Longest datagram. With its headers it fits the smallest path of IPv6, so it is never fragmented."""
FARTHEST = 2.0**24
"""Largest coordinate (m) of a position in a message: 16 777 km, so that UTM and earth-centred coordinates
fit. Moved by a correction, positions stay within 2³² cells of 2 cm, where rays can be cast."""
LARGEST_NUMBER = (1 << 60) - 1
"""Largest robot id, and largest number of anything that a robot counts."""
CODECS = ("quantized", "float", "thesis")
"""Encodings of components and counts."""
_KIND_BITS = 4
_CHECKSUM_BYTES = 4


class Kind(IntEnum):
    """The low half of a datagram's first byte; the high half is the version of the body. 14 is retired."""

    CALIBRATION = 0
    COMPONENTS = 1
    FLOAT_COMPONENTS = 2
    THESIS_COMPONENTS = 3
    COUNTS = 4
    FLOAT_COUNTS = 5
    THESIS_COUNTS = 6
    POINTS = 7
    VIEWS = 8
    PLAN = 9
    ANNOUNCEMENT = 10
    SUPERSESSION = 11
    COUNTERS = 12
    CORRECTION = 13
    FRAME = 15


OWN_CHECKSUM = frozenset({Kind.COMPONENTS})
"""Kinds whose body ends with a checksum of its own, and gets no second one."""
_SECOND_VERSION = frozenset({Kind.VIEWS, Kind.PLAN})


def first_byte(kind: Kind) -> int:
    """The first byte of a datagram: the version of the kind's body, and the kind. Records keep the version in
    which stores hold them."""
    return (1 + (kind in _SECOND_VERSION)) << _KIND_BITS | kind


def make_datagram(kind: Kind, body: bytes) -> bytes:
    """First byte, body, CRC-32 of both (4 bytes, little-endian)."""
    data = bytes([first_byte(kind)]) + body
    if kind in OWN_CHECKSUM:
        return data
    return data + zlib.crc32(data).to_bytes(_CHECKSUM_BYTES, "little")


def parse_datagram(datagram: bytes) -> tuple[Kind, bytes]:
    """Kind and body of a datagram. Raises `DataError` if it is too long, foreign or damaged."""
    if len(datagram) > MAX_BYTES:
        raise DataError(f"The datagram has {len(datagram)} bytes; {MAX_BYTES} are the most: it is foreign.")
    if not datagram:
        raise DataError("The datagram is empty.")
    version, number = datagram[0] >> _KIND_BITS, datagram[0] & ((1 << _KIND_BITS) - 1)
    try:
        kind = Kind(number)
    except ValueError as error:
        raise DataError(f"The datagram has the unknown kind {number}: it is foreign or damaged.") from error
    if datagram[0] != first_byte(kind):
        raise DataError(
            f"The datagram of kind {number} is of version {version}; this gmmtorch reads version "
            f"{first_byte(kind) >> _KIND_BITS}. It is foreign or damaged, or gmmtorch must be updated on one "
            "of the robots."
        )
    if kind in OWN_CHECKSUM:
        return kind, datagram[1:]
    data, checksum = datagram[:-_CHECKSUM_BYTES], datagram[-_CHECKSUM_BYTES:]
    if len(datagram) <= _CHECKSUM_BYTES or zlib.crc32(data) != int.from_bytes(checksum, "little"):
        raise DataError("The datagram does not match its checksum: it is truncated or damaged.")
    return kind, data[1:]


def check_datagram(datagram: bytes, least: int = 0) -> None:
    """Raise `InvalidArgumentError` unless a datagram is bytes, from `least` to `MAX_BYTES`."""
    if not isinstance(datagram, bytes) or not least <= len(datagram) <= MAX_BYTES:
        what = f"{len(datagram)} bytes" if isinstance(datagram, bytes) else type(datagram).__name__
        raise InvalidArgumentError(f"A datagram is {what}; it must be bytes, from {least} to {MAX_BYTES}.")


def split(
    n: int,
    encode: Callable[[int, int], bytes],
    what: str,
    max_bytes: int = MAX_BYTES,
    is_allowed: Callable[[int, int], bool] = lambda begin, end: True,
) -> list[bytes]:
    """Datagrams of n items, which are halved until each part fits. encode(begin, end) makes the datagram of
    items begin … end − 1; is_allowed(begin, end) tells whether they may be in one, however few bytes they
    take. Raises `InvalidArgumentError` if an item does not fit."""

    def parts(begin: int, end: int) -> list[bytes]:
        if end - begin == 1 or is_allowed(begin, end):
            datagram = encode(begin, end)
            if len(datagram) <= max_bytes:
                return [datagram]
            if end - begin == 1:
                raise InvalidArgumentError(
                    f"A single {what} takes {len(datagram)} bytes; a datagram has room for {max_bytes}. "
                    "Give it fewer sensor origins."
                )
        middle = (begin + end) // 2
        return parts(begin, middle) + parts(middle, end)

    return parts(0, n) if n else []


def check_codec(codec: str) -> str:
    """The codec; raises `InvalidArgumentError` unless it is one of `CODECS`."""
    check_choice("codec", codec, CODECS)
    return codec


def check_places(name: str, places: Tensor, farthest: float = FARTHEST) -> Tensor:
    """The positions (N, D), m; raises `InvalidArgumentError` if a coordinate is beyond `farthest`."""
    bad = ~(places.abs() <= farthest).all(1)
    if bool(bad.any()):
        first = int(bad.nonzero()[0])
        raise InvalidArgumentError(
            f"{name}[{first}] is {places[first].tolist()}; positions must be finite, and up to "
            f"{farthest:g} m on each axis. Is it in metres, and the world's origin near?"
        )
    return places


_LEAST_BITS = 8  # of a number in the stream
_NUMBERS = {2: 4, 3: 7}
"""Numbers of a rigid motion: in 2D a translation with cos and sin of the yaw; in 3D a translation with a unit
quaternion x, y, z, w; metres."""
_UNIT = 1e-9


def check_ids(name: str, ids: Tensor) -> Tensor:
    """The ids (J, 2); raises `InvalidArgumentError` unless they are int64, in range and distinct."""
    if ids.shape[1:] != (2,) or ids.dtype != torch.int64:
        raise InvalidArgumentError(f"{name} is {tuple(ids.shape)} of {ids.dtype}; expected (J, 2) of int64.")
    check_range(name, ids)
    if len(torch.unique(ids, dim=0)) != len(ids):
        raise InvalidArgumentError(f"{name} holds the same (robot, number) twice; give each once.")
    return ids


def check_range(name: str, ids: Tensor) -> None:
    """Raise `InvalidArgumentError` unless robots and numbers (J, 2) are in range."""
    if len(ids) and not 0 <= int(ids.min()) <= int(ids.max()) <= LARGEST_NUMBER:
        raise InvalidArgumentError(
            f"{name} reach from {int(ids.min())} to {int(ids.max())}; robots and numbers go from 0 to "
            f"{LARGEST_NUMBER}."
        )


def id_order(ids: Tensor) -> Ints:
    """The order (J,) that sorts ids by robot, then by number."""
    return np.lexsort((ids[:, 1].cpu().numpy(), ids[:, 0].cpu().numpy()))


def write_ids(writer: BitWriter, ids: Ints) -> None:
    """Write distinct ids (J, 2) in `id_order`: for each robot their number, the first, and the gaps."""
    robots, first, n_each = np.unique(ids[:, 0], return_index=True, return_counts=True)
    writer.number(len(robots))
    for robot, begin, n in zip(robots.tolist(), first.tolist(), n_each.tolist(), strict=True):
        numbers = ids[begin : begin + n, 1]
        writer.number(robot)
        writer.number(n)
        writer.number(int(numbers[0]))
        if n > 1:
            writer.short(np.diff(numbers) - 1)


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
        gaps = reader.short(n - 1) if n > 1 else np.zeros(0, np.int64)
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
    """Write their number; for each the gap before it, from `begin` or the last end, and its length − 1."""
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
    """The pose of a rigid motion (3, 3) or (4, 4); raises `InvalidArgumentError` if it is none."""
    if transform.shape not in ((3, 3), (4, 4)):
        raise InvalidArgumentError(f"transform has shape {tuple(transform.shape)}; give (3, 3) or (4, 4).")
    motion = Pose.checked(transform.detach(), len(transform) - 1, device="cpu")
    if not bool((motion.translation.abs() <= FARTHEST).all()):
        raise InvalidArgumentError(
            f"transform moves by {motion.translation.tolist()}; {FARTHEST:g} m is the most."
        )
    if motion.dim == 2:
        turn = torch.nn.functional.normalize(motion.rotation[:, 0], dim=0)
    else:
        turn = motion.quaternion()
        turn = -turn if turn[3] < 0 else turn  # of both signs, the one with w above zero
    return torch.cat([motion.translation, turn]) + 0.0  # no −0


def matrix_of(pose: Tensor) -> Tensor:
    """The motion (D+1, D+1) of a pose."""
    dim = motion_dim(pose)
    if dim == 3:
        return Pose.from_quaternion(pose[:3], pose[3:]).matrix
    cos, sin = pose[2:].tolist()
    return Pose(torch.tensor([[cos, -sin], [sin, cos]], dtype=torch.float64), pose[:2]).matrix


def write_motion(writer: BitWriter, pose: Tensor) -> None:
    """A bit for the dimension, then the numbers of a valid pose as float64."""
    writer.one(int(motion_dim(pose) == 3), 1)
    writer.fixed(pose.numpy().astype("<f8").view("<u4").astype(np.int64), 32)


def read_motion(reader: BitReader) -> Tensor:
    """What `write_motion` wrote; it may be no valid pose."""
    halves = reader.fixed(2 * _NUMBERS[2 + reader.one(1)], 32)
    return torch.from_numpy(halves.astype("<u4").view("<f8").astype(np.float64))
