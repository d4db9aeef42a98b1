"""Teams of robots with Zenoh on loopback."""

from __future__ import annotations

import socket
from collections.abc import Callable

import pytest
from sharing.transport_cases import Heard, until

from gmmtorch.team.sharing.transport.zenoh_transport import ZenohTransport

zenoh = pytest.importorskip("zenoh")
Opening = Callable[..., ZenohTransport]


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
