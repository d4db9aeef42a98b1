"""What all datagrams have in common: a first byte with version and kind, a checksum, and limits."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Callable, Sequence
from enum import IntEnum

from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError

VERSION = 1
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
    """The low half of a datagram's first byte; the high half is the version. 14 is retired."""

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


def make_datagram(kind: Kind, body: bytes) -> bytes:
    """First byte, body, CRC-32 of both (4 bytes, little-endian)."""
    data = bytes([VERSION << _KIND_BITS | kind]) + body
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
    if version != VERSION:
        raise DataError(
            f"The datagram is of version {version}; this gmmtorch reads version {VERSION}. It is foreign or "
            "damaged, or gmmtorch must be updated on one of the robots."
        )
    try:
        kind = Kind(number)
    except ValueError as error:
        raise DataError(f"The datagram has the unknown kind {number}: it is foreign or damaged.") from error
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
    """Datagrams of n items, which are halved until each part fits.

    encode(begin, end) makes the datagram of items begin … end − 1; is_allowed(begin, end) tells whether
    these may be in one datagram, however few bytes they take. Raises `InvalidArgumentError` if a single
    item does not fit.
    """

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


def within(datagrams: Sequence[bytes], budget: int | None) -> int:
    """How many of the first datagrams take at most `budget` bytes together; None: all."""
    sizes = itertools.accumulate(map(len, datagrams))
    return len(datagrams) if budget is None else sum(size <= budget for size in sizes)


def check_codec(codec: str) -> str:
    """The codec; raises `InvalidArgumentError` unless it is one of `CODECS`."""
    if codec not in CODECS:
        raise InvalidArgumentError(f"codec={codec!r} must be one of {', '.join(CODECS)}.")
    return codec


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
