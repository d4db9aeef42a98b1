"""The network of a robot from the options `transport` and `link.*`."""

from __future__ import annotations

import os
import socket
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from gmmtorch.cli import as_options, logger, naming
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.team.sharing import KEY_VARIABLE, FramedTransport, TeamKey, UdpTransport, ZenohTransport

TRANSPORTS = ("udp", "zenoh")
_NAMES = {"key": "link.key_file", "insecure": "link.insecure"}
_ZENOH_NAMES = {
    **_NAMES,
    "listen": "link.listen_endpoints",
    "connect": "link.connect_endpoints",
    "config": "link.zenoh_config",
    "team": "link.team",
}
_UDP_NAMES = {
    **_NAMES,
    "address": "link.listen",
    **{name: f"link.{name}" for name in ("peers", "group", "interface")},
}
"""Options by the arguments that they become, for error messages."""


def open_link(config: DictConfig, robot: int, is_alone: bool = False) -> FramedTransport:
    """A robot's end of the network of `transport` and `link.*`.

    is_alone: the robot has no team, so that no warning is due if it sends to no other robot.
    """
    link = _opened(config, robot, is_alone)
    # Other robots name this session if they meet two robots with this id.
    logger.info("Robot %d uses %s in session %s.", robot, config.transport, link.session.hex())
    return link


def _opened(config: DictConfig, robot: int, is_alone: bool) -> FramedTransport:
    check_choice("transport", config.transport, TRANSPORTS)
    link = as_options(config.link)
    key = team_key(link.pop("key_file"))
    if config.transport == "zenoh":
        with naming(_ZENOH_NAMES):
            return _zenoh(robot, link, key)
    with naming(_UDP_NAMES):
        if link["group"] is None and not link["peers"] and not is_alone:
            logger.warning(
                "link.peers=[]: robot %d sends to no other robot. List the addresses of the others, or give "
                "all the same link.group.",
                robot,
            )
        return _udp(robot, link, key)


def _zenoh(robot: int, link: dict[str, Any], key: TeamKey | None) -> FramedTransport:
    return ZenohTransport(
        robot,
        link["team"],
        listen=link["listen_endpoints"],
        connect=link["connect_endpoints"],
        config=link["zenoh_config"],
        key=key,
        insecure=link["insecure"],
    )


def _udp(robot: int, link: dict[str, Any], key: TeamKey | None) -> FramedTransport:
    insecure = link["insecure"]
    if link["group"] is not None:
        group = address("link.group", link["group"], least_port=1)
        return UdpTransport.multicast(robot, group, link["interface"], key=key, insecure=insecure)
    listen = address("link.listen", link["listen"])
    peers = [address("link.peers", peer, least_port=1) for peer in link["peers"]]
    return UdpTransport.unicast(robot, listen, peers, key=key, insecure=insecure)


def team_key(path: str | None) -> TeamKey | None:
    """The team's key, from a file or else from the environment; None without either."""
    if path is not None:
        return TeamKey.from_file(Path(path))
    return TeamKey.from_environment() if KEY_VARIABLE in os.environ else None


def address(name: str, text: str, least_port: int = 0) -> tuple[str, int]:
    """The address of a text host:port. Port 0 means any free port."""
    host, colon, port = str(text).rpartition(":")
    if (
        not colon
        or not host
        or not (port.isascii() and port.isdigit())
        or not least_port <= int(port) <= 65535
    ):
        raise InvalidArgumentError(f"{name}={text!r} must be an address and a port, as in 127.0.0.1:7447.")
    return host, int(port)


def free_addresses(n: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[str]:
    """Addresses of `n` free ports on loopback."""
    sockets = [socket.socket(socket.AF_INET, kind) for _ in range(n)]
    try:
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [f"127.0.0.1:{one.getsockname()[1]}" for one in sockets]
    finally:
        for one in sockets:
            one.close()
