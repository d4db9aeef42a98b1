"""Teams of robots with Zenoh on loopback."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import pytest

from gmmtorch.sharing.transport.team_key import TeamKey
from gmmtorch.sharing.transport.zenoh_transport import ZenohTransport

zenoh = pytest.importorskip("zenoh")
KEY = TeamKey(bytes(range(32)))
Opening = Callable[..., ZenohTransport]
Heard = list[tuple[int, bytes]]


def endpoint(protocol: str = "tcp") -> str:
    """An endpoint with a free port."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"{protocol}/127.0.0.1:{probe.getsockname()[1]}"


def greet(transports: list[ZenohTransport]) -> None:
    """Waits until each robot has received from all others."""
    met: dict[int, set[int]] = {transport.robot: set() for transport in transports}

    def all_met() -> bool:
        for transport in transports:
            transport.send(transport.robot, [b"hello"], 0.0, "greetings")
            met[transport.robot] |= {who for who, _ in transport.deliver(transport.robot, 0.0)}
        return all(len(others) == len(transports) - 1 for others in met.values())

    until(all_met)


def wait_until_connected(transports: list[ZenohTransport]) -> None:
    """Until each has received all others' greetings; links keep the order."""
    greet(transports)
    for transport in transports:
        transport.send(transport.robot, [b"met"], 0.0, "greetings")
    for transport in transports:
        said: Heard = []
        until(lambda t=transport, s=said: s.extend(t.deliver(t.robot, 0.0)) or ends(s, len(transports) - 1))


def ends(said: Heard, n: int) -> bool:
    return sum(what == b"met" for _, what in said) == n


def until(is_done: Callable[[], bool]) -> None:
    """Waits for a condition; fails after a minute."""
    end = time.monotonic() + 60
    while not is_done():
        assert time.monotonic() < end
        time.sleep(0.005)


def heard(transport: ZenohTransport, n: int) -> Heard:
    """The next n datagrams."""
    found: Heard = []
    until(lambda: len(found.extend(transport.deliver(transport.robot, 0.0)) or found) >= n)
    return found
