"""Keys of records: the robot, its incarnation, and a number.

A record's id is (robot, sequence), as a component's in a map; sequence = incarnation · 2²⁸ + number. A
robot draws a new incarnation whenever it starts, and numbers its records from 0. So a robot that lost its
disk, or whose disk is older than its last datagrams, gives no id twice, without knowing its earlier
records. Two of n incarnations are equal with probability n²/2²⁵: 3·10⁻⁶ for ten.

Here an id is one whole number, the key: robot · 2⁵² + sequence. An author is one incarnation of a robot, as
the number robot · 2²⁴ + incarnation.
"""

from __future__ import annotations

import secrets

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.mapping.codec.bitstream import BitReader
from gmmtorch.mapping.codec.lattice import AXIS_ORDERS
from gmmtorch.sharing.messages.envelope import Kind, parse_datagram
from gmmtorch.sharing.replica.intervals import Intervals, Ints

NUMBER_BITS, INCARNATION_BITS, ROBOT_BITS = 28, 24, 10
SEQUENCE_BITS = INCARNATION_BITS + NUMBER_BITS
LARGEST_ROBOT = (1 << ROBOT_BITS) - 1
LARGEST_INCARNATION = (1 << INCARNATION_BITS) - 1
MOST_RECORDS = 1 << NUMBER_BITS
"""Records of one author."""
END = 1 << (ROBOT_BITS + SEQUENCE_BITS)
"""Keys are below it."""
RECORD_KINDS = frozenset({Kind.COMPONENTS, Kind.SUPERSESSION, Kind.COUNTERS, Kind.CORRECTION})
"""Kinds of datagrams that contain records."""


def drawn_incarnation() -> int:
    """A random incarnation from the machine's entropy. A seeded one would be equal after a restart."""
    return secrets.randbits(INCARNATION_BITS)


def first_key(robot: int, incarnation: int = 0) -> int:
    """The smallest key of a robot's incarnation."""
    return robot << SEQUENCE_BITS | incarnation << NUMBER_BITS


def keys_of_robot(robot: int) -> Intervals:
    """All keys that a robot can give."""
    return Intervals.span(first_key(robot), first_key(robot + 1))


def keys_of_author(robot: int, incarnation: int) -> Intervals:
    """All keys that a robot can give in one incarnation."""
    begin = first_key(robot, incarnation)
    return Intervals.span(begin, begin + MOST_RECORDS)


def robot_of(key: int) -> int:
    return key >> SEQUENCE_BITS


def author_of(key: int) -> int:
    return key >> NUMBER_BITS


def authors(keys: Ints) -> Ints:
    """The authors (N,) of keys (N,)."""
    return keys >> NUMBER_BITS


def ids_of(keys: Ints) -> Tensor:
    """(robot, sequence) (N, 2) of keys (N,)."""
    return torch.from_numpy(np.stack([keys >> SEQUENCE_BITS, keys & ((1 << SEQUENCE_BITS) - 1)], 1))


def keys_of(ids: Tensor) -> Ints:
    """Keys (N,) of (robot, sequence) (N, 2). Raises `DataError` if they are out of range, or not distinct."""
    rows = ids.cpu().numpy().astype(np.int64)
    most = np.array([LARGEST_ROBOT, (1 << SEQUENCE_BITS) - 1])
    bad = ((rows < 0) | (rows > most)).any(1)
    if bad.any():
        raise DataError(
            f"Record {tuple(rows[bad][0].tolist())} is out of range: robots go from 0 to {LARGEST_ROBOT}, "
            f"sequences from 0 to {most[1]}."
        )
    keys = rows[:, 0] << SEQUENCE_BITS | rows[:, 1]
    if len(np.unique(keys)) != len(keys):
        raise DataError("Two records have the same id.")
    return keys


def keys_in(datagram: bytes) -> Intervals:
    """The keys of the records in a datagram that a replica has sent or merged, without decoding the rest.

    Raises `DataError` if it is no datagram of `RECORD_KINDS`.
    """
    kind, body = parse_datagram(datagram)
    if kind is Kind.COMPONENTS:
        return Intervals.of(_component_keys(BitReader(body[1:])))
    if kind not in RECORD_KINDS:
        raise DataError(f"A datagram of kind {int(kind)} has no records.")
    key = BitReader(body).number()
    return Intervals.span(key, key + 1)


def _component_keys(batch: BitReader) -> Ints:
    """The keys of a codec batch (docs/formats.md): three numbers and the axis orders precede its ids."""
    dim, k, _ = batch.number(), batch.number(), batch.number()
    if dim not in AXIS_ORDERS or k < 0:
        raise DataError(f"{k} components in {dim}D: it is damaged.")
    n_bits = (len(AXIS_ORDERS[dim]) - 1).bit_length()
    batch.require(k * n_bits)
    batch.fixed(k, n_bits)
    robots, numbers = batch.column(k), batch.column(k) + np.arange(k)
    return keys_of(torch.from_numpy(np.stack([robots, numbers], 1)))
