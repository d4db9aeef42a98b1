"""UdpTransport: datagrams over UDP, to a list of peers or a multicast group; encrypted if the team has a
key."""

from __future__ import annotations

import errno
import ipaddress
import selectors
import socket
import struct
import sys
import threading
from collections.abc import Callable, Sequence

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.team.sharing.transport.frames import MAX_WAITING, FramedTransport
from gmmtorch.team.sharing.transport.security import TeamKey
from gmmtorch.team.sharing.transport.simulated_network import Traffic

Address = tuple[str, int]
"""An IPv4 address, and a port."""
LOOPBACK = "127.0.0.1"
_BUFFER_BYTES = 4 << 20  # requested of the system for received datagrams
_LARGEST_READ = 1 << 16
_SO_RXQ_OVFL = 40  # of Linux; Python has no name for it
_IP_MULTICAST_ALL = 49  # of Linux; Python has no name for it
_PAUSE = 0.01  # seconds, after the socket has failed
_HAS_NOTES = hasattr(socket.socket, "recvmsg_into")  # not on Windows
_BINDS_GROUPS = sys.platform != "win32"  # there a socket must be bound to an address of the machine


class UdpTransport(FramedTransport):
    """One robot's end of a network; see `FramedTransport`.

    `failures` counts datagrams that cannot be sent by ENETUNREACH, ENOBUFS, …. A thread reads the socket,
    opens the frames and queues the datagrams, so that any time may pass between two calls of `deliver`.
    `sent` counts a copy for each peer.

    Attributes:
        address: where the socket is bound, with the port that was chosen if 0 was given.
        n_overflowed: datagrams that the system had no room for (Linux).
    """

    def __init__(
        self,
        robot: int,
        make_socket: Callable[[], socket.socket],
        key: TeamKey | None = None,
        max_waiting: int = MAX_WAITING,
    ) -> None:
        """For sockets made otherwise; use `unicast` or `multicast`. make_socket: makes the bound socket,
        which the transport closes. Datagrams are sent to its own address until `peers` are set."""
        super().__init__(robot, key, max_waiting)
        self.n_overflowed = 0
        self._socket = make_socket()
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        if sys.platform == "linux":
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self.address: Address = self._socket.getsockname()
        self._peers = [self.address]
        self._wake, self._woken = socket.socketpair()
        self._thread = threading.Thread(target=self._listen, name=f"udp-{self.robot}", daemon=True)
        self._thread.start()

    @classmethod
    def unicast(
        cls,
        robot: int,
        address: Address = (LOOPBACK, 0),
        peers: Sequence[Address] = (),
        *,
        key: TeamKey | None = None,
        insecure: bool = False,
        max_waiting: int = MAX_WAITING,
    ) -> UdpTransport:
        """Sends a copy of each datagram to each peer.

        Args:
            robot: id of this robot, 0 … 65535; unique in the team.
            address: where to listen: an address of this machine, or 0.0.0.0 for all, and a port; 0: any.
            peers: where the others listen; can be changed later.
            key: the team's. Without one the address must be on loopback, unless `insecure`.
            max_waiting: largest number of datagrams in the queue.

        Raises `InvalidArgumentError` for an address that is invalid, is in use, or needs a key.
        """
        _check_key("address", address, key, insecure)
        _check_peers(peers, address)
        transport = cls(robot, lambda: unicast_socket(address), key, max_waiting)
        transport.peers = peers
        return transport

    @classmethod
    def multicast(
        cls,
        robot: int,
        group: Address,
        interface: str = LOOPBACK,
        ttl: int = 1,
        *,
        key: TeamKey | None = None,
        insecure: bool = False,
        max_waiting: int = MAX_WAITING,
    ) -> UdpTransport:
        """Sends each datagram once, to all that have joined the group, also on this machine.

        group: an address 224.0.0.0 … 239.255.255.255 (239.… are for private use), and a port. interface: the
        address of this machine's interface to the team's network. ttl: how many networks a datagram may
        cross, 0 … 255; 1: it does not pass a router.

        The other arguments and errors are those of `unicast`; here the interface needs a key.
        """
        if not check_address("group", group).is_multicast:
            raise InvalidArgumentError(
                f"group={group[0]!r} must be a multicast address, such as 239.71.77.7."
            )
        _check_key("interface", (interface, 0), key, insecure)
        transport = cls(robot, lambda: multicast_socket(group, interface, ttl), key, max_waiting)
        # The socket's own address is not the group's where it cannot be bound to one.
        transport.address = (group[0], transport.address[1])
        transport._peers = [transport.address]
        return transport

    @property
    def peers(self) -> list[Address]:
        """Addresses that datagrams are sent to."""
        return list(self._peers)

    @peers.setter
    def peers(self, peers: Sequence[Address]) -> None:
        _check_peers(peers, self.address)
        self._peers = list(peers)

    def _carry(self, frame: bytes, kind: str) -> Traffic:
        """Send a copy to each peer."""
        n_sent = n_bytes = 0
        for peer in self._peers:
            try:
                n_bytes += self._socket.sendto(frame, peer)
                n_sent += 1
            except OSError as error:
                self._failed(error, f"to {peer[0]}:{peer[1]}")
        return Traffic(n_sent, n_bytes)

    def _shut(self) -> None:
        self._wake.send(b"\0")
        self._thread.join()
        for each in (self._socket, self._wake, self._woken):
            each.close()

    def _listen(self) -> None:
        """Read the socket until the transport is closed."""
        buffer = memoryview(bytearray(_LARGEST_READ))
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            selector.register(self._woken, selectors.EVENT_READ)
            while not self._closing.is_set():
                selector.select()
                self._read(buffer)

    def _read(self, buffer: memoryview) -> None:
        """Read all frames that the socket has."""
        while not self._closing.is_set():
            try:
                size, notes, source = self._received(buffer)
            except BlockingIOError:
                return
            except OSError as error:
                self._failed(error, "from the network")
                self._closing.wait(_PAUSE)
                return
            self._count_overflow(notes)
            self._take(bytes(buffer[:size]), f"{source[0]}:{source[1]}")

    def _received(self, buffer: memoryview) -> tuple[int, list[tuple[int, int, bytes]], Address]:
        """Number of bytes of the next frame, notes of the system, and the sender. Raises `OSError`."""
        if not _HAS_NOTES:
            size, source = self._socket.recvfrom_into(buffer)
            return size, [], source
        size, notes, _, source = self._socket.recvmsg_into([buffer], socket.CMSG_SPACE(4))
        return size, notes, source

    def _count_overflow(self, notes: list[tuple[int, int, bytes]]) -> None:
        """Read how many datagrams the system has had no room for so far, which Linux reports with each
        one."""
        for level, kind, data in notes:
            if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                self.n_overflowed = struct.unpack("=I", data)[0]

    def _failed(self, error: OSError, direction: str) -> None:
        name = errno.errorcode.get(error.errno or 0, "unknown")
        self._count_failure(name, f"{error.strerror}", direction)


def unicast_socket(address: Address) -> socket.socket:
    """A socket bound to an address of this machine that no other socket has."""
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    return _bound(bound, "address", address, ", or 0 for any that is free")


def multicast_socket(group: Address, interface: str, ttl: int) -> socket.socket:
    """A socket that has joined one group on one interface. Many sockets may share the port."""
    check_whole("ttl", ttl, 0, 255)
    bound = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    if sys.platform == "linux":  # else it would receive what other sockets joined on other interfaces
        bound.setsockopt(socket.IPPROTO_IP, _IP_MULTICAST_ALL, 0)
    elif hasattr(socket, "SO_REUSEPORT"):  # BSD shares a port only with this option
        bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEPORT, 1)
    _bound(bound, "group", group if _BINDS_GROUPS else ("", group[1]))
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
            "that this machine has on the team's network (`ip -4 address`). To start before there is a "
            "network, give no group: listen on 0.0.0.0, and list the peers."
        ) from error
    return bound


def _bound(unbound: socket.socket, name: str, address: Address, alternative: str = "") -> socket.socket:
    try:
        unbound.bind(address)
    except OSError as error:
        unbound.close()
        remedies = {
            errno.EADDRINUSE: "another process has that port. Stop it (`ss -ulpn` shows it), or give "
            f"another port{alternative}",
            errno.EADDRNOTAVAIL: "this machine has no such address, or not yet. `ip -4 address` lists those "
            "it has; 0.0.0.0 is all of them, later ones included: with it a robot starts without a network",
            errno.EACCES: "ports below 1024 are for the system. Give one above",
        }
        remedy = remedies.get(error.errno or 0, f"{error.strerror}")
        raise InvalidArgumentError(
            f"{name}={address[0]}:{address[1]} cannot be listened on: {remedy}."
        ) from error
    return unbound


def check_address(name: str, address: Address, least_port: int = 0) -> ipaddress.IPv4Address:
    """The host of an address (host, port); raises `InvalidArgumentError` if it is invalid."""
    try:
        host, port = address
        parsed = ipaddress.IPv4Address(host if isinstance(host, str) else "")
    except (TypeError, ValueError) as error:
        raise InvalidArgumentError(
            f"{name}={address!r} must be an IPv4 address, such as '10.0.0.3', and a port; names are not "
            "looked up."
        ) from error
    check_whole(f"port of {name}", port, least_port, 65535)
    return parsed


def _check_key(name: str, address: Address, key: TeamKey | None, insecure: bool) -> None:
    """Without a key, an address beyond this machine must be allowed explicitly."""
    host = check_address(name, address)
    if key is None and not insecure and not host.is_loopback:
        raise InvalidArgumentError(
            f"{name}={str(host)!r} reaches other machines, and there is no key (‹key›=None): give one, "
            f"or take {LOOPBACK}; in Python, insecure=True lets anyone read and write."
        )


def _check_peers(peers: Sequence[Address], address: Address) -> None:
    is_local = check_address("address", address).is_loopback
    for peer in peers:
        host = check_address("peers", peer, 1)
        if host.is_multicast:
            raise InvalidArgumentError(f"peers={peer!r} is a group; use UdpTransport.multicast.")
        if is_local and not host.is_loopback:
            raise InvalidArgumentError(
                f"peers={peer!r} cannot be reached from ‹address›={address[0]!r}, which only this machine "
                "reaches; listen on 0.0.0.0, with a key."
            )
