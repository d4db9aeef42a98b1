"""UDP sockets of IPv4: bound to an address or to a multicast group, with errors that say what to do."""

from __future__ import annotations

import errno
import ipaddress
import socket
import sys

from gmmtorch.errors import InvalidArgumentError, check_whole

Address = tuple[str, int]
"""An IPv4 address, and a port."""
LOOPBACK = "127.0.0.1"
_IP_MULTICAST_ALL = 49  # of Linux; Python has no name for it


def unicast_socket(address: Address) -> socket.socket:
    """A socket bound to an address of this machine, which no other socket has."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return _bound(bound, "address", address, ", or 0 for any that is free")


def multicast_socket(group: Address, interface: str, ttl: int) -> socket.socket:
    """A socket that has joined a group on one interface, and hears no other; many may share the port."""
    if check_whole("ttl", ttl, 0) > 255:
        raise InvalidArgumentError(f"ttl={ttl} must be at most 255.")
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if sys.platform == "linux":  # else it would hear what others joined on other interfaces
        bound.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    elif hasattr(socket, "SO_REUSEPORT"):  # BSD shares a port only so
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    _bound(bound, "group", group)
    try:
        card = socket.inet_aton(interface)
        bound.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton(group[0]) + card)
        bound.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, card)
        bound.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_LOOP, 1)
        bound.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, ttl)
    except OSError as error:
        bound.close()
        raise InvalidArgumentError(
            f"interface={interface!r} cannot join the group {group[0]}: {error.strerror}. Give the address "
            "that this machine has on the team's network (`ip -4 address`). To start before there is one, "
            "take no group: listen on 0.0.0.0, and name the peers."
        ) from error
    return bound


def check_address(name: str, address: Address, least_port: int = 0) -> ipaddress.IPv4Address:
    """The host of an address, if that is one, (host, port); else `InvalidArgumentError`."""
    try:
        host, port = address
        parsed = ipaddress.IPv4Address(host if isinstance(host, str) else "")
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"{name}={address!r} must be an IPv4 address, such as '10.0.0.3', and a port; names are not "
            "looked up."
        ) from error
    if check_whole(f"port of {name}", port, least_port) > 65535:
        raise InvalidArgumentError(f"port of {name}={port} must be at most 65535.")
    return parsed


def _bound(unbound: socket.socket, name: str, address: Address, or_else: str = "") -> socket.socket:
    try:
        unbound.bind(address)
    except OSError as error:
        unbound.close()
        remedies = {
            errno.EADDRINUSE: "another process has that port. Stop it (`ss -ulpn` shows it), or give "
            f"another port{or_else}",
            errno.EADDRNOTAVAIL: "this machine has no such address, or not yet. `ip -4 address` shows those "
            "it has; 0.0.0.0 is all of them, also those to come: with it a robot starts without a network",
            errno.EACCES: "ports below 1024 are for the system. Give one above",
        }
        remedy = remedies.get(error.errno or 0, f"{error.strerror}")
        raise InvalidArgumentError(
            f"{name}={address[0]}:{address[1]} cannot be listened on: {remedy}."
        ) from error
    return unbound
