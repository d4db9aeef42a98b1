"""A team's key, hostile frames, a clock that tests set, and waiting for datagrams of real networks."""

from __future__ import annotations

import random
import time
from collections.abc import Callable

from gmmtorch.team.sharing.transport.frames import FramedTransport
from gmmtorch.team.sharing.transport.security import Sealer, TeamKey

SECRET = bytes(range(32))
KEY = TeamKey(SECRET)
Heard = list[tuple[int, bytes]]


class Clock:
    now = 0.0

    def __call__(self) -> float:
        return self.now


def until(is_done: Callable[[], bool]) -> None:
    """Waits for a condition; fails after a minute."""
    end = time.monotonic() + 60
    while not is_done():
        assert time.monotonic() < end
        time.sleep(0.002)


def heard(transport: FramedTransport, n: int) -> Heard:
    """The next n datagrams."""
    found: Heard = []
    until(lambda: len(found.extend(transport.deliver(transport.robot, 0.0)) or found) >= n)
    return found


def hostile_frames(frame: bytes, sender: int) -> dict[str, list[bytes]]:
    """Frames that a robot with `KEY` refuses, by the reason. frame: one that it has accepted."""
    rng = random.Random(0)
    return {
        "foreign": [b"", b"hello", b"\x11" + rng.randbytes(1199)],
        "oversized": [rng.randbytes(1232), bytes(60000)],
        "version": [b"\xf3" + rng.randbytes(99)],
        "malformed": [frame[:30], b"\xf1"],
        "wrong_key": [
            frame[:-1],
            frame[:-1] + bytes([frame[-1] ^ 1]),
            Sealer(sender, TeamKey.generate()).seal(b"x"),
            Sealer(sender).seal(b"x"),
        ],
        "replayed": [frame, frame],
    }
