"""Datagrams over UDP: to a list of peers, or to a multicast group; sealed, where the team has a key."""

from __future__ import annotations

import errno
import selectors
import socket
import struct
import sys
import threading
from collections.abc import Callable, Sequence

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.transport.frames import MAX_WAITING, FramedTransport
from gmmtorch.sharing.transport.security import TeamKey
from gmmtorch.sharing.transport.simulated_network import Traffic
from gmmtorch.sharing.transport.sockets import (
    LOOPBACK,
    Address,
    check_address,
    multicast_socket,
    unicast_socket,
)

_BUFFER_BYTES = 4 << 20  # asked of the system for what it keeps; it gives what it allows
_LARGEST_READ = 1 << 16
_SO_RXQ_OVFL = 40  # of Linux; Python has no name for it
_REST = 0.01  # seconds, after the socket has failed


class UdpTransport(FramedTransport):
    """One robot's end of a network; see `Transport`. To be closed, or used as a context manager.

    Lost datagrams stay lost. A network that is down is no error: what cannot be sent is counted in
    `failures`, by the name of the error: ENETUNREACH, ENOBUFS, …. A thread takes what comes in from the
    socket, opens it (`Opener`), and lets it wait, so that a robot may think for as long as it likes between
    two calls of `deliver`. `sent` counts a copy for each peer.
    """

    def __init__(
        self,
        robot: int,
        opened: Callable[[], socket.socket],
        key: TeamKey | None = None,
        max_waiting: int = MAX_WAITING,
    ) -> None:
        """For sockets made otherwise; `unicast` and `multicast` make theirs.

        `opened`: makes the socket, bound to where it listens, which is also where it sends to until `peers`
        are given. It is closed with this.
        """
        super().__init__(robot, key, max_waiting)
        self.n_overflowed = 0
        """Datagrams that the system had no room for, as far as it says so (Linux)."""
        self._socket = opened()
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER_BYTES)
        if sys.platform == "linux":
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
        self.address: Address = self._socket.getsockname()
        """Where the socket is bound; the port that was chosen, where 0 was asked for."""
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
        """A copy of each datagram goes to each peer.

        Args:
            robot: this robot's number, 0 … 65535, which no other has.
            address: where to listen: an address of this machine, or 0.0.0.0 for all, and a port; 0: any.
            peers: where the others listen; may be set later, too.
            key: the team's. Without one the address must be on loopback, unless `insecure`.
            max_waiting: how many datagrams may wait to be delivered.

        Raises `InvalidArgumentError` for an address that is none, is taken, or needs a key.
        """
        _check_reach("address", address, key, insecure)
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
        """Each datagram is sent once, to all who have joined the group, also on this machine.

        Args:
            group: an address 224.0.0.0 … 239.255.255.255 (239.… are for private use), and a port.
            interface: the address of this machine's interface to the team's network.
            ttl: how many networks away it may go, 0 … 255; 1: not past a router.

        The others, and what is raised, as in `unicast`; here it is the interface that needs a key.
        """
        if not check_address("group", group).is_multicast:
            raise InvalidArgumentError(
                f"group={group[0]!r} must be a multicast address, such as 239.71.77.7."
            )
        _check_reach("interface", (interface, 0), key, insecure)
        return cls(robot, lambda: multicast_socket(group, interface, ttl), key, max_waiting)

    @property
    def peers(self) -> list[Address]:
        """Where datagrams are sent to."""
        return list(self._peers)

    @peers.setter
    def peers(self, peers: Sequence[Address]) -> None:
        _check_peers(peers, self.address)
        self._peers = list(peers)

    # -- inside --------------------------------------------------------------------------------------------

    def _carry(self, frame: bytes, kind: str) -> Traffic:
        """A copy to each peer."""
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
        """Until the transport is closed: take in what comes."""
        buffer = memoryview(bytearray(_LARGEST_READ))
        with selectors.DefaultSelector() as selector:
            selector.register(self._socket, selectors.EVENT_READ)
            selector.register(self._woken, selectors.EVENT_READ)
            while not self._closing.is_set():
                selector.select()
                self._read(buffer)

    def _read(self, buffer: memoryview) -> None:
        """Take in what the socket holds."""
        while not self._closing.is_set():
            try:
                size, notes, _, source = self._socket.recvmsg_into([buffer], socket.CMSG_SPACE(4))
            except BlockingIOError:
                return
            except OSError as error:
                self._failed(error, "from the network")
                self._closing.wait(_REST)
                return
            self._note(notes)
            self._take(bytes(buffer[:size]), f"{source[0]}:{source[1]}")

    def _note(self, notes: list[tuple[int, int, bytes]]) -> None:
        """What Linux tells with a datagram: how many it has had no room for so far."""
        for level, kind, data in notes:
            if (level, kind) == (socket.SOL_SOCKET, _SO_RXQ_OVFL):
                self.n_overflowed = struct.unpack("=I", data)[0]

    def _failed(self, error: OSError, whither: str) -> None:
        self._fails(errno.errorcode.get(error.errno or 0, "unknown"), f"{error.strerror}", whither)


def _check_reach(name: str, address: Address, key: TeamKey | None, insecure: bool) -> None:
    """Without a key nobody outside this machine is spoken to by accident."""
    host = check_address(name, address)
    if key is None and not insecure and not host.is_loopback:
        raise InvalidArgumentError(
            f"{name}={str(host)!r} reaches other machines, and there is no key (key=None): give one, "
            f"take {LOOPBACK}, or say insecure=True to let anybody read and write."
        )


def _check_peers(peers: Sequence[Address], address: Address) -> None:
    is_local = check_address("address", address).is_loopback
    for peer in peers:
        host = check_address("peers", peer, 1)
        if host.is_multicast:
            raise InvalidArgumentError(f"peers={peer!r} is a group; use UdpTransport.multicast.")
        if is_local and not host.is_loopback:
            raise InvalidArgumentError(
                f"peers={peer!r} cannot be reached from address={address[0]!r}, which is this machine alone; "
                "listen on 0.0.0.0, with a key."
            )
