"""Names of records: whose, of which of its authors, and which of them.

A record is named (robot, sequence), as a component is in a map, and a sequence is incarnation · 2²⁸ + number.
A robot draws a new incarnation whenever it starts, and numbers what it says in it from 0. So a robot that
lost its disk, or whose disk is older than what it last said, gives no name twice, without having to know
what it said before. Two of n lives get the same incarnation with probability n²/2²⁵: 3·10⁻⁶ for ten.

Here a name is one whole number, its key: robot · 2⁵² + sequence.
"""

from __future__ import annotations

import secrets

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError
from gmmtorch.sharing.replica.intervals import Intervals, Ints

NUMBER_BITS, INCARNATION_BITS, ROBOT_BITS = 28, 24, 10
SEQUENCE_BITS = INCARNATION_BITS + NUMBER_BITS
LARGEST_ROBOT = (1 << ROBOT_BITS) - 1
LARGEST_INCARNATION = (1 << INCARNATION_BITS) - 1
MOST_RECORDS = 1 << NUMBER_BITS
"""Of one life of a robot."""
END = 1 << (ROBOT_BITS + SEQUENCE_BITS)
"""Keys are below it."""


def drawn_incarnation() -> int:
    """From the machine's entropy: a seed would draw the same again in the next life."""
    return secrets.randbits(INCARNATION_BITS)


def first_key(robot: int, incarnation: int = 0) -> int:
    return robot << SEQUENCE_BITS | incarnation << NUMBER_BITS


def keys_of_robot(robot: int) -> Intervals:
    """All keys that a robot may give."""
    return Intervals.span(first_key(robot), first_key(robot + 1))


def keys_of_author(robot: int, incarnation: int) -> Intervals:
    """All keys that a robot may give in one of its lives."""
    begin = first_key(robot, incarnation)
    return Intervals.span(begin, begin + MOST_RECORDS)


def robot_of(key: int) -> int:
    return key >> SEQUENCE_BITS


def author_of(key: int) -> int:
    """Robot and incarnation of a key, as one number."""
    return key >> NUMBER_BITS


def authors(keys: Ints) -> Ints:
    """Robot and incarnation (N,) of keys, as one number."""
    return keys >> NUMBER_BITS


def ids_of(keys: Ints) -> Tensor:
    """(robot, sequence) (N, 2) of keys."""
    return torch.from_numpy(np.stack([keys >> SEQUENCE_BITS, keys & ((1 << SEQUENCE_BITS) - 1)], 1))


def keys_of(ids: Tensor) -> Ints:
    """Keys (N,) of (robot, sequence) (N, 2). Raises `DataError` for what is out of range, or comes twice."""
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
        raise DataError("A record comes twice.")
    return keys
