"""Hostile datagrams that follow the formats: zero counts, extreme numbers, valid checksums.

Most fields have usual values, so that decoders read far; a few have invalid ones. All values are drawn from a
`random.Random`, so that a benchmark can draw millions and hypothesis can shrink them.
"""

from __future__ import annotations

import functools
import math
import struct
import zlib
from collections.abc import Callable
from dataclasses import fields, replace
from random import Random

import numpy as np
import torch
from mapping.random_components import random_components

from gmmtorch.mapping import BitWriter, Quantized, encode_quantized, quantize
from gmmtorch.mapping.codec.lattice import Lattice
from gmmtorch.mapping.codec.thesis_message import UPDATE_TYPE, message_type
from gmmtorch.team.sharing.messages.datagrams import MAX_BYTES, Kind, first_byte
from gmmtorch.team.sharing.replica.record_keys import END

WIDE = 1 << 62
_WHOLE = [0, 1, -1, 2, 63, 255, 1023, 1024, 1 << 24, 1 << 28, 1 << 31, 1 << 52, 1 << 60, END - 1, -END + 1]
_REAL = [0.0, -0.0, 1.0, -1.0, 5e-324, 1e-30, 5e5, 2.0**14, 2.0**24, 2.0**27, 2.0**40, 2.0**53, 1e30, 1e155]
_REAL += [1e300, -1e300, math.inf, -math.inf, math.nan]
_ODD = 0.06  # share of fields with an unusual value


def structured(kind: Kind, rng: Random) -> bytes:
    """A datagram of a kind with valid checksums."""
    body = _BODIES[kind](rng)[: MAX_BYTES - 5]
    head = bytes([first_byte(kind)])
    if kind == Kind.COMPONENTS:
        return head + body + zlib.crc32(body).to_bytes(4, "little")
    return head + body + zlib.crc32(head + body).to_bytes(4, "little")


# -- numbers ---------------------------------------------------------------------------------------------


def _whole(rng: Random, usual: int) -> int:
    return rng.choice(_WHOLE) + rng.choice([0, 0, 1, -1]) if rng.random() < _ODD else usual


def _size(rng: Random, most: int = 12) -> int:
    """A random number of items."""
    return rng.choice([0, 1, 1, 2, rng.randint(0, most)])


def _reals(rng: Random, *shape: int, scale: float = 10.0) -> np.ndarray:
    """Numbers of this scale; in some arrays one or all are extreme."""
    values = np.array([rng.uniform(-scale, scale) for _ in range(math.prod(shape))])
    if len(values) and rng.random() < 3 * _ODD:
        values[rng.randrange(len(values)) if rng.random() < 0.7 else slice(None)] = rng.choice(_REAL)
    return values.reshape(shape)


def _number(writer: BitWriter, rng: Random, usual: int) -> int:
    """Writes a number and returns it before it is clipped to the format."""
    value = _whole(rng, usual)
    writer.number(max(-WIDE + 1, min(value, WIDE - 1)))
    return value


def _noise(writer: BitWriter, rng: Random, n: int) -> None:
    writer.fixed(np.array([rng.getrandbits(1) for _ in range(min(n, 8 * MAX_BYTES))], np.int64), 1)


def _column(writer: BitWriter, rng: Random, n: int, least: int, largest: int) -> None:
    """Numbers from `least` to `largest`, or n equal numbers, which take no bits, or random bits."""
    choice = rng.random()
    if choice < 0.5:
        writer.column(np.array([rng.randint(least, largest) for _ in range(min(n, 400))], np.int64))
    elif choice < 1 - _ODD:
        writer.one(0, 8)  # code and parameter
        _number(writer, rng, rng.randint(least, largest))
    else:
        writer.one(rng.randrange(4), 2)
        parameter = rng.choice([0, 1, 3, 8, 40, 62, 63])
        writer.one(parameter, 6)
        _number(writer, rng, least)
        _noise(writer, rng, n * (1 + parameter % 9))


def _ids(writer: BitWriter, rng: Random, most: int = 12) -> int:
    """Ids of some robots; returns their number."""
    n_robots, total, robot = _size(rng, 3), 0, -1
    _number(writer, rng, n_robots)
    for _ in range(n_robots):
        robot += rng.randint(1, 3)
        _number(writer, rng, robot)
        n = max(0, min(_number(writer, rng, rng.randint(1, most)), 4000))
        _number(writer, rng, rng.randint(0, 50))
        if n > 1:
            if rng.random() < 0.5:
                writer.one(0, 6)  # gaps of zero take one bit each
                writer.fixed(np.ones(n - 1, np.int64), 1)
            else:
                largest = rng.choice([1, 5, 300])
                writer.short(np.array([rng.randint(0, 5) for _ in range(n - 2)] + [largest], np.int64))
        total += n
    return total


def _intervals(writer: BitWriter, rng: Random, most: int = 6) -> None:
    n = rng.randint(0, most)
    _number(writer, rng, n)
    for _ in range(n):
        _number(writer, rng, rng.randint(1, 9))
        _number(writer, rng, rng.randint(0, 9))


def _key(writer: BitWriter, rng: Random) -> None:
    _number(writer, rng, rng.randrange(4) << 52 | rng.randrange(3) << 28 | rng.randrange(50))


# -- bodies ----------------------------------------------------------------------------------------------


def _batch(rng: Random) -> bytes:
    """A valid batch with some changed numbers or with many equal components."""
    values = made = _sound(rng.choice([2, 3, 3]), rng.randint(1, 9))
    if rng.random() < 0.3:
        values = _many(values, rng.choice([200, 1024, 1025, 3000]))
    for _ in range(rng.choice([0, 1, 1, 2])):
        values = _altered(values, rng)
    if rng.random() < 0.4:
        return _with_block(encode_quantized(made), rng, len(made))
    try:
        with np.errstate(invalid="raise"):
            batch = encode_quantized(values)
    except (ValueError, RuntimeError, LookupError, ArithmeticError):  # the encoder refuses it
        batch = encode_quantized(made)
    body = bytearray(batch[:-4])
    if rng.random() < 0.2:
        body[rng.randrange(1, min(len(body), 12))] = rng.choice([0, 1, 2, 4, 126, 128, 254, 255])
    return bytes(body)


def _with_block(batch: bytes, rng: Random, k: int) -> bytes:
    """A batch of k components with channels: names, columns, shares, labels and numbers of any size."""
    size, block = BitWriter(), BitWriter()
    _number(size, rng, len(batch) - 4)
    n_channels = rng.randint(0, 3)
    _number(block, rng, n_channels)
    for _ in range(n_channels):
        name = rng.choice([b"colour", b"class", b"x", b"\xff", b"x" * 64])
        _number(block, rng, len(name))
        block.fixed(np.frombuffer(name, np.uint8).astype(np.int64), 8)
        width = _number(block, rng, 3 if name == b"colour" else rng.choice([0, 0, 1, 8]))
        if width:
            data = rng.randbytes(rng.choice([0, 1, 9, 60]))
            _number(block, rng, len(data))
            block.fixed(np.frombuffer(data, np.uint8).astype(np.int64), 8)
        else:
            n_labels = _number(block, rng, rng.choice([0, 1, 2, 9, 256, 65536]))
            _column(block, rng, max(n_labels, 0), 0, 30)
            for _ in range(4):
                _column(block, rng, k, 0, 3)
    return b"\3" + size.to_bytes() + batch[:-4] + b"\1" + block.to_bytes()


@functools.cache
def _sound(dim: int, k: int) -> Quantized:
    return quantize(random_components(dim, k=k, seed=k))


def _many(values: Quantized, k: int) -> Quantized:
    """The first component k times, with the same origins; a few bits each."""
    n = max(int(values.n_viewpoints[0]), 1)
    rows = torch.zeros(k, dtype=torch.int64)
    numbered = values.ids[rows] + torch.stack([rows, torch.arange(k)], 1)
    return replace(
        values.arranged(torch.tensor([0])),
        places=values.places.taken(rows),
        count=values.count[rows],
        max_range=values.max_range[rows],
        ids=numbered,
        n_viewpoints=torch.full((k,), n),
        seen_from=torch.arange(n).repeat(k),
        share=torch.zeros(k * n, dtype=torch.int64),
    )


_OTHERS = {  # the first three take as many bits as their value
    "shear": [0, 1, -1, 9, 500],
    "n_viewpoints": [0, 1, 2, 49, 1025],
    "axis_order": [0, 1, 5, 6, 7],
    "deviation": [0, 72, 80, 81, 160, -80, -81, -240],
    "mean": [*_WHOLE, 1 << 35, 1 << 45],
    "count": [*_WHOLE, -41, -42, 160, 161],
    "ids": [*_WHOLE, (1 << 62) - 1],
    "origins": [*_WHOLE, 1 << 32, 1 << 35],
    "seen_from": _WHOLE,
    "share": [0, 15, 16, 1 << 40],
}


def _altered(values: Quantized, rng: Random) -> Quantized:
    """With one field of the batch or its places changed in one row or all rows."""
    name = rng.choice(list(_OTHERS))
    in_places = name in {f.name for f in fields(Lattice)}
    whole = values.places if in_places else values
    changed = getattr(whole, name).clone()
    rows = rng.randrange(len(changed)) if len(changed) and rng.random() < 0.5 else slice(None)
    changed[rows] = rng.choice(_OTHERS[name])
    if in_places:
        return replace(values, places=replace(values.places, **{name: changed}))
    return replace(values, **{name: changed})


def _float_components(rng: Random) -> bytes:
    dim, k, s, e = rng.choice([2, 3, 3]), _size(rng, 5), _size(rng, 3), _size(rng, 5)
    roots = _reals(rng, k, dim, dim, scale=1.0)
    with np.errstate(all="ignore"):
        covariances = roots @ roots.transpose(0, 2, 1) + 1e-3 * np.eye(dim)
    rows, cols = np.triu_indices(dim)
    arrays = [
        _reals(rng, k, dim).astype("<f8"),
        covariances[:, rows, cols].astype("<f8"),
        np.abs(_reals(rng, k)).astype("<f8"),
        np.array([_whole(rng, rng.randrange(2)) % 256 for _ in range(k)], "u1"),
        np.array([_whole(rng, i) for i in range(2 * k)], "<i8"),
        _reals(rng, s, dim).astype("<f8"),
        np.array([_whole(rng, rng.randrange(max(k, 1))) % 65536 for _ in range(e)], "<u2"),
        np.array([_whole(rng, rng.randrange(max(s, 1))) % 65536 for _ in range(e)], "<u2"),
        np.abs(_reals(rng, e)).astype("<f8"),
    ]
    sizes = [_whole(rng, n) % (1 << 32) for n in (k, s, e)]
    head = struct.pack("<BIII", _whole(rng, dim) % 256, *sizes)
    return b"".join([head, *(array.tobytes() for array in arrays)])


def _thesis_components(rng: Random) -> bytes:
    n = _size(rng, 20)
    rows = np.zeros(n, message_type(3))
    with np.errstate(all="ignore"):
        rows["id"] = [_whole(rng, rng.randrange(9)) % (1 << 32) for _ in range(n)]
        rows["num_points"] = np.abs(_reals(rng, n))
        rows["sensor_loc"], rows["mean"] = _reals(rng, n, 3), _reals(rng, n, 3)
        rows["covariance"] = np.abs(_reals(rng, n, 6, scale=0.01)) + np.array([1, 0, 0, 1, 0, 1])
    rows["max_range"] = [_whole(rng, 0) % 256 for _ in range(n)]
    return rows.tobytes()


def _counts(rng: Random) -> bytes:
    writer = BitWriter()
    _number(writer, rng, 1)
    _column(writer, rng, _ids(writer, rng), -41, 160)
    return writer.to_bytes()


def _rows_of_counts(rng: Random, kind: Kind) -> bytes:
    n, writer = _size(rng), BitWriter()
    _number(writer, rng, 1)
    counts = np.abs(_reals(rng, n, scale=1e4))
    if kind == Kind.FLOAT_COUNTS:
        rows = np.zeros(n, [("robot", "<i8"), ("number", "<i8"), ("count", "<f8")])
        rows["robot"], rows["number"] = [_whole(rng, 1) for _ in range(n)], [_whole(rng, i) for i in range(n)]
        rows["count"] = counts
    else:
        rows = np.zeros(n, UPDATE_TYPE)
        rows["id"] = [_whole(rng, i) % (1 << 32) for i in range(n)]
        with np.errstate(all="ignore"):
            rows["num_points"] = counts
    return writer.to_bytes() + rows.tobytes()


def _points(rng: Random) -> bytes:
    n = rng.choice([0, 1, 8, rng.randint(0, 95)])
    part, n_parts = _whole(rng, rng.randrange(3)) % 65536, _whole(rng, 3) % 65536
    head = struct.pack(
        "<HI3dHHH", rng.randrange(9), _whole(rng, 5) % (1 << 32), *_reals(rng, 3), part, n_parts, n
    )
    with np.errstate(all="ignore"):
        offsets = _reals(rng, n, 3).astype("<f4")
    hits = np.packbits([rng.getrandbits(1) for _ in range(n)]).tobytes() if n else b""
    return head + offsets.tobytes() + hits


def _poses(writer: BitWriter, rng: Random, n: int) -> None:
    for axis in range(4 if n else 0):
        _column(writer, rng, n, 0, 255 if axis == 3 else 5000)


def _views(rng: Random) -> bytes:
    writer = BitWriter()
    n = _ids(writer, rng)
    _poses(writer, rng, n)
    _column(writer, rng, n, -rng.choice([0, 9, 300]), rng.choice([247, 248, 300]))
    _column(writer, rng, n, 0, 10**6)
    _intervals(writer, rng)
    return writer.to_bytes()


def _plan(rng: Random) -> bytes:
    writer = BitWriter()
    n, n_views = rng.choice([_size(rng), 1000, 1001]), _size(rng)
    numbers = [_whole(rng, usual) for usual in (1, n, n_views, rng.choice([0, 5000]), 7, 200)]
    writer.golomb(np.array(numbers, np.int64).clip(0, WIDE - 1), 2)
    n, n_views = numbers[1:3]
    for _ in range(3 if n else 0):
        _number(writer, rng, rng.randrange(5000))
    if n:
        writer.one(rng.randrange(256), 8)
    _moves(writer, rng, min(n - 1, 1), (4, 3))
    _moves(writer, rng, n - 2, (2, 0))
    _moves(writer, rng, n_views, (3, 1))
    return writer.to_bytes()


def _moves(writer: BitWriter, rng: Random, n: int, lows: tuple[int, int]) -> None:
    for low in lows if n > 0 else ():
        largest = rng.choice([9, 9, 9, 300, 1 << 33, 1 << 36, WIDE - 1])
        writer.golomb(np.array([rng.randint(0, largest) for _ in range(min(2 * n, 800))], np.int64), low)


def _announcement(rng: Random) -> bytes:
    writer = BitWriter()
    for usual in (1, 2, 0, rng.choice([-1, END - 1])):
        _number(writer, rng, usual)
    _intervals(writer, rng, 40)
    return writer.to_bytes()


def _supersession(rng: Random) -> bytes:
    writer = BitWriter()
    _key(writer, rng)
    _intervals(writer, rng)
    _intervals(writer, rng, 1)
    return writer.to_bytes()


def _totals(rng: Random) -> bytes:
    writer = BitWriter()
    _key(writer, rng)
    _column(writer, rng, _ids(writer, rng, rng.choice([12, 3000])), -41, 160)
    return writer.to_bytes()


def _correction(rng: Random) -> bytes:
    writer = BitWriter()
    _key(writer, rng)
    _number(writer, rng, 3)
    _number(writer, rng, 1)
    _motion(writer, rng)
    _intervals(writer, rng)
    return writer.to_bytes()


def _frame(rng: Random) -> bytes:
    writer = BitWriter()
    _key(writer, rng)
    for usual in (5, 1, rng.choice([0, 9])):
        _number(writer, rng, usual)
    if rng.random() < 0.9:
        _motion(writer, rng)
    return writer.to_bytes()


def _calibration(rng: Random) -> bytes:
    writer = BitWriter()
    _key(writer, rng)
    values = np.array([rng.gauss(0, 1) for _ in range(14)])
    values[:2] = 2.0, 6.125
    if rng.random() < 3 * _ODD:
        values[rng.randrange(14)] = rng.choice(_REAL)
    with np.errstate(over="ignore"):
        data = values.astype("<f2").tobytes()
    writer.fixed(np.frombuffer(data, np.uint8).astype(np.int64), 8)
    return writer.to_bytes()


def _motion(writer: BitWriter, rng: Random) -> None:
    dim = rng.choice([2, 3])
    writer.one(dim - 2, 1)
    turn = np.array([1.0, *(rng.uniform(-2, 2) for _ in range(1 if dim == 2 else 3))])
    pose = np.concatenate([_reals(rng, dim), turn / np.linalg.norm(turn)])
    if rng.random() < 3 * _ODD:
        pose[rng.randrange(len(pose))] = rng.choice(_REAL)
    writer.fixed(pose.astype("<f8").view("<u4").astype(np.int64), 32)


_BODIES: dict[Kind, Callable[[Random], bytes]] = {
    Kind.CALIBRATION: _calibration,
    Kind.COMPONENTS: _batch,
    Kind.FLOAT_COMPONENTS: _float_components,
    Kind.THESIS_COMPONENTS: _thesis_components,
    Kind.COUNTS: _counts,
    Kind.FLOAT_COUNTS: lambda rng: _rows_of_counts(rng, Kind.FLOAT_COUNTS),
    Kind.THESIS_COUNTS: lambda rng: _rows_of_counts(rng, Kind.THESIS_COUNTS),
    Kind.POINTS: _points,
    Kind.VIEWS: _views,
    Kind.PLAN: _plan,
    Kind.ANNOUNCEMENT: _announcement,
    Kind.SUPERSESSION: _supersession,
    Kind.COUNTERS: _totals,
    Kind.CORRECTION: _correction,
    Kind.FRAME: _frame,
}
