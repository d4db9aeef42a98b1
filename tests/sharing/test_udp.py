"""UDP transport: real sockets on loopback, foreign datagrams and failures."""

from __future__ import annotations

import errno
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack

import pytest
from sharing.transport_cases import KEY, heard, hostile_frames, until

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.team.sharing.transport.security import Sealer, TeamKey
from gmmtorch.team.sharing.transport.simulated_network import Network, Traffic, Transport
from gmmtorch.team.sharing.transport.udp import UdpTransport

GROUP = "239.71.77.7"
Opening = Callable[..., UdpTransport]


@pytest.fixture
def opening() -> Iterator[Opening]:
    """Opens transports that are closed after the test."""
    with ExitStack() as stack:
        yield lambda robot, *a, **options: stack.enter_context(UdpTransport.unicast(robot, *a, **options))


@pytest.fixture
def raw() -> Iterator[socket.socket]:
    """A plain socket."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as bound:
        bound.bind(("127.0.0.1", 0))
        bound.settimeout(10)
        yield bound


def team(opening: Opening, n: int, **options: object) -> list[UdpTransport]:
    """Transports of robots 0 … n − 1, each with all others as its peers."""
    transports = [opening(robot, **options) for robot in range(n)]
    for transport in transports:
        transport.peers = [other.address for other in transports if other is not transport]
    return transports


# -- deliveries and statistics --------------------------------------------------------------------


@pytest.mark.parametrize("key", [KEY, None])
def test_every_peer_receives_each_datagram_once_in_order(opening, key):
    transports: list[Transport] = list(team(opening, 3, key=key))
    sent = [bytes([i]) * (i * 40) for i in range(31)]
    transports[1].send(1, sent, 0.0, "maps")
    for robot in (0, 2):
        assert heard(transports[robot], 31) == [(1, datagram) for datagram in sent]
        assert transports[robot].deliver(robot, 1.0) == []
    assert transports[1].deliver(1, 1.0) == []


@pytest.mark.parametrize("key", [KEY, None])
def test_sent_bytes_equal_the_simulated_network_plus_frames(opening, raw, key):
    """Against a plain socket that receives the datagrams, and against `Network` with the same input."""
    a, b = team(opening, 2, key=key)
    a.peers = [b.address, raw.getsockname()]
    network, rng, n_measured, n_bytes = Network(2), random.Random(0), 0, 0
    for turn in range(20):
        datagrams = [rng.randbytes(rng.randrange(1201)) for _ in range(rng.randrange(4))]
        kind = rng.choice(["maps", "plans"])
        a.send(0, datagrams, float(turn), kind)
        network.send(0, datagrams, float(turn), kind)
        for _ in datagrams:
            n_measured += 1
            n_bytes += len(raw.recv(2000))
    for sender in (0, 1, None):
        for kind in ("maps", "plans", None):
            assert a.traffic(sender, kind) == network.traffic(sender, kind)
    assert a.overhead == (31 if key else 15)
    assert n_bytes == network.traffic().bytes + a.overhead * n_measured
    assert a.sent == Traffic(2 * n_measured, 2 * n_bytes)
    assert a.sent.wire_bytes == 2 * (n_bytes + 28 * n_measured)
    until(lambda: b.received == Traffic(n_measured, n_bytes))
    assert a.failures == {}


@pytest.fixture
def multicast() -> None:
    """Skips if plain sockets cannot reach a group on loopback."""
    options = [
        (socket.IP_ADD_MEMBERSHIP, socket.inet_aton(GROUP) + socket.inet_aton("127.0.0.1")),
        (socket.IP_MULTICAST_IF, socket.inet_aton("127.0.0.1")),
    ]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.settimeout(1)
        try:
            probe.bind(("", 0))
            for option, value in options:
                probe.setsockopt(socket.IPPROTO_IP, option, value)
            probe.sendto(b"probe", (GROUP, probe.getsockname()[1]))
            probe.recv(100)
        except OSError as error:
            pytest.skip(f"no multicast on loopback here: {error}")


@pytest.mark.usefixtures("multicast")
@pytest.mark.parametrize(("key", "binds_groups"), [(KEY, True), (None, True), (KEY, False)])
def test_multicast_sends_once_and_delivers_to_the_others_only(key, binds_groups, monkeypatch):
    monkeypatch.setattr("gmmtorch.team.sharing.transport.udp._BINDS_GROUPS", binds_groups)
    with ExitStack() as stack:
        a = stack.enter_context(UdpTransport.multicast(0, (GROUP, 0), key=key))
        group = a.address
        assert group[0] == GROUP
        b, c = (stack.enter_context(UdpTransport.multicast(i, group, key=key)) for i in (1, 2))
        a.send(0, [b"x", b"y"], 0.0, "maps")
        assert [heard(each, 2) for each in (b, c)] == [[(0, b"x"), (0, b"y")]] * 2
        until(lambda: a.refused["echo"] == 2)
        assert a.deliver(0, 0.0) == []
        assert (a.books(0)["refused"], a.books(0)["neighbours"]) == ({}, None)
        assert a.sent == a.received == b.received == Traffic(2, 2 * (1 + a.overhead))
        with pytest.raises(InvalidArgumentError, match=f"address=.*:{group[1]} .*another process"):
            UdpTransport.unicast(3, ("0.0.0.0", group[1]), key=KEY)


OTHER_PROCESS = """
import os, socket, sys
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
aead = ChaCha20Poly1305(bytes(range(32)))
me = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
me.bind(("127.0.0.1", 0))
me.settimeout(10)
print(me.getsockname()[1], flush=True)
session = os.urandom(8)
for number in range(50):
    frame, sender = me.recvfrom(2000)
    datagram = aead.decrypt(frame[3:15], frame[15:], frame[:15])
    header = b"\\xf1" + (7).to_bytes(2, "little") + session + number.to_bytes(4, "little")
    me.sendto(header + aead.encrypt(header[3:], datagram[::-1], header), sender)
"""


def test_an_independent_implementation_of_the_format_takes_part(opening):
    """A process that implements docs/network.md without this package."""
    a = opening(0, key=KEY)
    with subprocess.Popen([sys.executable, "-c", OTHER_PROCESS], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        a.peers = [("127.0.0.1", int(other.stdout.readline()))]
        sent = [f"datagram {i}".encode() for i in range(50)]
        a.send(0, sent, 0.0, "maps")
        assert heard(a, 50) == [(7, datagram[::-1]) for datagram in sent]
        assert other.wait(10) == 0


# -- foreign datagrams ----------------------------------------------------------------------------


def test_foreign_datagrams_are_counted_and_ignored(opening, raw):
    a, b = team(opening, 2, key=KEY)
    a.peers = [*a.peers, raw.getsockname()]
    a.send(0, [b"one"], 0.0, "maps")
    frame = raw.recv(2000)
    hostile = hostile_frames(frame, sender=0)
    for datagrams in hostile.values():
        for datagram in datagrams:
            raw.sendto(datagram, b.address)
    a.send(0, [b"two"], 0.0, "maps")
    assert heard(b, 2) == [(0, b"one"), (0, b"two")]
    assert {reason: n for reason, n in b.refused.items() if n} == {r: len(d) for r, d in hostile.items()}
    sizes = [len(datagram) for datagrams in hostile.values() for datagram in datagrams]
    assert b.received == Traffic(2 + len(sizes), 2 * 34 + sum(sizes))


def test_a_full_queue_keeps_the_newest_datagrams(opening):
    a, b = team(opening, 2, key=KEY, max_waiting=100)
    for i in range(250):
        a.send(0, [i.to_bytes(2, "little")], 0.0, "maps")
    until(lambda: b.received.datagrams == 250)
    assert b.deliver(1, 0.0) == [(0, i.to_bytes(2, "little")) for i in range(150, 250)]
    assert b.n_dropped == 150


def test_datagrams_arrive_without_the_calls_that_windows_lacks(opening, monkeypatch):
    monkeypatch.setattr("gmmtorch.team.sharing.transport.udp._HAS_NOTES", False)
    a, b = team(opening, 2, key=KEY)
    a.send(0, [b"one", bytes(1000)], 0.0, "maps")
    until(lambda: b.received.datagrams == 2)
    assert b.deliver(1, 0.0) == [(0, b"one"), (0, bytes(1000))]


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux counts what a socket has no room for")
def test_datagrams_dropped_by_the_system_are_counted(opening, raw, monkeypatch):
    """The receiving thread is blocked until the buffer of the socket overflows."""
    monkeypatch.setattr("gmmtorch.team.sharing.transport.udp._BUFFER_BYTES", 1 << 14)
    b = opening(1)
    sealer, n = Sealer(0), 200
    with b._lock:
        for _ in range(n):
            raw.sendto(sealer.seal(bytes(1000)), b.address)
    until(lambda: not heard_any(b))
    raw.sendto(sealer.seal(b"last"), b.address)  # this datagram carries the count
    until(lambda: b.deliver(1, 0.0) == [(0, b"last")])
    assert b.n_overflowed > 0
    assert b.received.datagrams + b.n_overflowed == n + 1


def heard_any(transport: UdpTransport) -> bool:
    before = transport.received
    time.sleep(0.05)
    transport.deliver(transport.robot, 0.0)
    return transport.received != before


# -- addresses and failures -----------------------------------------------------------------------


def test_without_a_key_only_loopback_is_allowed_by_default(opening):
    for open_it in (
        lambda **o: UdpTransport.unicast(0, ("0.0.0.0", 0), **o),
        lambda **o: UdpTransport.multicast(0, (GROUP, 0), "0.0.0.0", **o),
    ):
        with pytest.raises(InvalidArgumentError, match=r"no key.*insecure=True"):
            open_it()
    for options in ({"key": KEY}, {"insecure": True}):
        with UdpTransport.unicast(0, ("0.0.0.0", 0), [("10.0.0.5", 7447)], **options) as transport:
            assert transport.peers == [("10.0.0.5", 7447)]
    assert opening(0).address[0] == "127.0.0.1"
    with pytest.raises(InvalidArgumentError, match=r"10\.0\.0\.5.*cannot be reached"):
        opening(0).peers = [("10.0.0.5", 7447)]
    with pytest.raises(InvalidArgumentError, match=r"10\.0\.0\.5.*cannot be reached"):
        opening(0, peers=[("10.0.0.5", 7447)])


def test_a_port_in_use_is_reported_with_its_remedy(opening):
    taken = opening(0).address
    with pytest.raises(
        InvalidArgumentError, match=f"address=.*:{taken[1]} .*another process.*another port, or 0"
    ):
        opening(1, taken)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": 65536}, "sender=65536"),
        ({"address": ("localhost", 0)}, "address=.*IPv4 address"),
        ({"address": ("::1", 0)}, "address=.*IPv4 address"),
        ({"address": "127.0.0.1"}, "address='127.0.0.1'"),
        ({"address": (2130706433, 0)}, "address=.*IPv4 address"),
        ({"address": ("127.0.0.1", 65536)}, "65535"),
        ({"address": ("127.0.0.1", -1)}, "port of address=-1"),
        ({"address": ("198.51.100.7", 0), "key": KEY}, r"no such address.*0\.0\.0\.0"),
        ({"peers": [("127.0.0.1", 0)]}, "port of peers=0"),
        ({"peers": [("robot1", 7447)]}, "names are not looked up"),
        ({"peers": [(GROUP, 7447)]}, "multicast"),
        ({"max_waiting": 0}, "max_waiting=0"),
    ],
)
def test_invalid_options_are_refused(options, message):
    n_threads = threading.active_count()
    with pytest.raises(InvalidArgumentError, match=message):
        UdpTransport.unicast(**{"robot": 0, **options})
    assert threading.active_count() == n_threads


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"group": ("10.0.0.1", 7447)}, "group=.*multicast address"),
        ({"interface": "eth0"}, "interface="),
        (
            {"interface": "198.51.100.7", "key": KEY},
            r"interface='198.51.100.7'.*ip -4 address.*0\.0\.0\.0",
        ),
        ({"ttl": 256}, "ttl=256"),
        ({"ttl": -1}, "ttl=-1"),
    ],
)
def test_groups_that_cannot_be_joined_are_refused(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        UdpTransport.multicast(**{"robot": 0, "group": (GROUP, 0), **options})


class Unplugged:
    """A socket whose sends fail."""

    def __init__(self, bound: socket.socket, code: int) -> None:
        self._bound, self._code = bound, code

    def sendto(self, *_: object) -> int:
        raise OSError(self._code, "away")

    def __getattr__(self, name: str) -> object:
        return getattr(self._bound, name)


@pytest.mark.parametrize("name", ["ENETUNREACH", "EHOSTUNREACH", "EPERM", "ENOBUFS", "EAGAIN", "ENETDOWN"])
def test_an_unreachable_network_is_counted_without_an_error(opening, caplog, name):
    a, b = team(opening, 2, key=KEY)
    plugged = a._socket
    a._socket = Unplugged(plugged, getattr(errno, name))
    for _ in range(5):
        a.send(0, [b"x", b"y"], 0.0, "maps")
    assert a.failures == {name: 10}
    assert len(caplog.messages) == 1
    assert (a.sent, a.traffic()) == (Traffic(), Traffic(10, 10))
    a._socket = plugged
    a.send(0, [b"z"], 0.0, "maps")
    assert heard(b, 1) == [(0, b"z")]
    assert a.sent == Traffic(1, 32)


def test_a_transport_serves_only_its_own_robot(opening):
    a, b = team(opening, 2)
    with pytest.raises(InvalidArgumentError, match="sender=1 must be 0"):
        a.send(1, [b"x"], 0.0, "maps")
    with pytest.raises(InvalidArgumentError, match="robot=1 must be 0"):
        a.deliver(1, 0.0)
    for datagrams, message in (([b"", bytes(1201)], "1201 bytes"), (["text"], "str")):
        with pytest.raises(InvalidArgumentError, match=message):
            a.send(0, datagrams, 0.0, "maps")
    assert a.sent == a.traffic() == b.received == Traffic()


def test_close_releases_port_and_thread_and_is_idempotent():
    n_threads = threading.active_count()
    with UdpTransport.unicast(0) as transport:
        assert threading.active_count() == n_threads + 1
        assert f"{transport.robot}" in threading.enumerate()[-1].name
    transport.close()
    assert threading.active_count() == n_threads
    for use in (lambda: transport.send(0, [b"x"], 0.0, "maps"), lambda: transport.deliver(0, 0.0)):
        with pytest.raises(GmmTorchError, match="closed"):
            use()
    with UdpTransport.unicast(1, transport.address) as other:
        assert other.address == transport.address


def test_keys_never_appear_in_messages_or_representations(opening, caplog):
    a, b = opening(0, key=KEY), opening(1, key=TeamKey.generate())
    b.peers = [a.address]
    b.send(1, [b"x"], 0.0, "maps")
    until(lambda: a.refused["wrong_key"] == 1)
    assert bytes(range(32)).hex()[:8] not in caplog.text + repr(a) + repr(vars(a)) + repr(vars(a._opener))
