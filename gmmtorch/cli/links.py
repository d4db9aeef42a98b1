"""The networks that the options `link.*` describe."""

from __future__ import annotations

import ipaddress
import os
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from gmmtorch.sharing.framed_transport import FramedTransport
    from gmmtorch.sharing.security import TeamKey

TRANSPORTS = ("udp", "zenoh")
_PATIENCE = 10.0  # seconds for robots of this machine to find one another
_PAUSE = 0.02


def open_link(config: DictConfig, robot: int) -> FramedTransport:
    """A robot's end of the network of `transport` and `link.*`."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.sharing.udp import UdpTransport

    link = common.as_options(config.link)
    key = team_key(link.pop("key_file"))
    common_options: dict[str, Any] = {"key": key, "insecure": link["insecure"]}
    if config.transport == "zenoh":
        from gmmtorch.sharing.zenoh_transport import ZenohTransport

        return ZenohTransport(
            robot,
            link["team"],
            listen=link["listen_endpoints"],
            connect=link["connect_endpoints"],
            scouting=link["scouting"],
            config=link["zenoh_config"],
            **common_options,
        )
    if config.transport != "udp":
        raise InvalidArgumentError(f"transport={config.transport!r} is not one of {', '.join(TRANSPORTS)}.")
    if link["group"] is not None:
        group = address("link.group", link["group"])
        _check_key("link.interface", link["interface"], link["insecure"], key)
        return UdpTransport.multicast(robot, group, link["interface"], link["ttl"], **common_options)
    peers = [address("link.peers", peer) for peer in link["peers"]]
    listen = address("link.listen", link["listen"])
    _check_key("link.listen", listen[0], link["insecure"], key)
    return UdpTransport.unicast(robot, listen, peers, **common_options)


def _check_key(name: str, host: str, insecure: bool, key: TeamKey | None) -> None:
    """What transports check, too, and say in terms of Python."""
    from gmmtorch.errors import InvalidArgumentError

    try:
        is_local = ipaddress.IPv4Address(host).is_loopback
    except ValueError:
        return  # of which the transport says what is wrong
    if key is None and not insecure and not is_local:
        raise InvalidArgumentError(
            f"{name}={host} reaches other machines, and there is no key: give link.key_file=FILE, take "
            "127.0.0.1, or say link.insecure=true to let anybody read and write."
        )


def await_team(transport: FramedTransport, n_others: int) -> None:
    """Wait until so many are connected; not for long, and only where there are connections."""
    from gmmtorch.sharing.zenoh_transport import ZenohTransport

    end = time.monotonic() + _PATIENCE
    while (
        isinstance(transport, ZenohTransport) and transport.n_neighbours < n_others and time.monotonic() < end
    ):
        time.sleep(_PAUSE)


def team_key(path: str | None) -> TeamKey | None:
    """The team's key: of the file, or of the environment where there is one."""
    from gmmtorch.sharing.security import TeamKey
    from gmmtorch.sharing.team_key import KEY_VARIABLE

    if path is not None:
        return TeamKey.from_file(Path(path))
    return TeamKey.from_environment() if KEY_VARIABLE in os.environ else None


def address(name: str, text: str) -> tuple[str, int]:
    """host:port as an address."""
    from gmmtorch.errors import InvalidArgumentError

    host, colon, port = str(text).rpartition(":")
    if not colon or not host or not (port.isascii() and port.isdigit()) or int(port) > 65535:
        raise InvalidArgumentError(f"{name}={text!r} must be an address and a port, as in 127.0.0.1:7447.")
    return host, int(port)


def free_addresses(n: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[str]:
    """So many addresses on loopback that nobody uses now."""
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(n)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [f"127.0.0.1:{one.getsockname()[1]}" for one in sockets]
    finally:
        for one in sockets:
            one.close()
