"""Zenoh transport: real sessions on loopback without scouting, and foreign datagrams."""

from __future__ import annotations

import json
import random
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack

import pytest
from sharing.schedules import components
from sharing.transport_cases import KEY, heard, hostile_frames, until
from sharing.zenoh_cases import Opening, endpoint, greet, wait_until_connected, zenoh

from gmmtorch.errors import GmmTorchError
from gmmtorch.team.sharing.radio import Radio
from gmmtorch.team.sharing.replica.replica import Replica
from gmmtorch.team.sharing.transport.security import Sealer
from gmmtorch.team.sharing.transport.simulated_network import Traffic, Transport
from gmmtorch.team.sharing.transport.zenoh_transport import ZenohTransport


@pytest.fixture
def stranger() -> Iterator[Callable[[str], zenoh.Session]]:
    """Opens sessions of a stranger, connected to an endpoint."""
    with ExitStack() as stack:
        yield lambda endpoint: stack.enter_context(zenoh.open(plain("client", connect=[endpoint])))


def plain(mode: str, **endpoints: list[str]) -> zenoh.Config:
    """The configuration of a session without our code."""
    config = zenoh.Config()
    settings = {"mode": mode, "scouting/multicast/enabled": False}
    settings |= {f"{name}/endpoints": value for name, value in endpoints.items()}
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    return config


def team(opening: Opening, endpoints: list[str], **options: object) -> list[ZenohTransport]:
    """Transports of robots 0 … n − 1, each connected to all before it; all have received from one another."""
    transports = [
        opening(robot, listen=[where], connect=endpoints[:robot], **options)
        for robot, where in enumerate(endpoints)
    ]
    wait_until_connected(transports)
    return transports


# -- deliveries and statistics ---------------------------------------------------------------------


@pytest.mark.parametrize(("key", "protocol"), [(KEY, "tcp"), (None, "tcp"), (KEY, "udp")])
def test_all_others_receive_each_datagram_once_and_in_order(opening, key, protocol):
    transports: Sequence[Transport] = team(opening, [endpoint(protocol) for _ in range(3)], key=key)
    sent = [bytes([i]) * (i * 40) for i in range(31)]
    for i, datagram in enumerate(sent):
        transports[1].send(1, [datagram], 0.0, ("components", "plans", "announcements", "counts")[i % 4])
    for robot in (0, 2):
        assert heard(transports[robot], 31) == [(1, datagram) for datagram in sent]
        assert transports[robot].deliver(robot, 1.0) == []
    assert transports[1].deliver(1, 1.0) == []


@pytest.mark.parametrize("key", [KEY, None])
def test_sent_counts_each_frame_once(opening, stranger, key):
    """Against a plain session that listens."""
    where = endpoint()
    a = opening(0, listen=[where], key=key)
    sizes: list[int] = []
    stranger(where).declare_subscriber("gmmtorch/team/0", lambda sample: sizes.append(len(sample.payload)))
    until(lambda: a.send(0, [b"hello"], 0.0, "greetings") or len(sizes) > 0)
    a.send(0, [bytes(1000)], 0.0, "greetings")
    until(lambda: sizes[-1] == 1000 + a.overhead)
    before, n_before = a.sent, len(sizes)
    datagrams = [bytes(n) for n in (0, 7, 1200, 300)]
    a.send(0, datagrams, 1.0, "maps")
    until(lambda: len(sizes) == n_before + 4)
    assert sizes[n_before:] == [len(datagram) + a.overhead for datagram in datagrams]
    assert a.sent == Traffic(before.datagrams + 4, before.bytes + sum(sizes[n_before:]))
    assert (a.received, a.failures) == (Traffic(), {})


def test_replicas_converge_and_one_that_comes_late_catches_up(opening):
    endpoints = [endpoint() for _ in range(3)]
    first, second = team(opening, endpoints[:2], key=KEY)
    replicas = {first: Replica(0), second: Replica(1)}

    def exchange() -> None:
        for transport, replica in replicas.items():
            for _, datagram in transport.deliver(transport.robot, 0.0):
                replica.receive(datagram)
            transport.send(transport.robot, replica.datagrams(), 0.0, "components")
            transport.send(transport.robot, replica.announcements(), 0.0, "announcements")

    def agree() -> bool:
        exchange()
        return len({replica.digest() for replica in replicas.values()}) == 1

    replicas[first].add(components(random.Random(0), 300))
    replicas[second].add(components(random.Random(1), 200))
    until(agree)
    assert replicas[first].n_components == 500
    third = opening(2, listen=endpoints[2:], connect=endpoints[:2], key=KEY)
    replicas[third] = Replica(2)
    until(agree)
    assert replicas[third].n_components == 500


def test_robots_connect_through_a_common_peer(opening):
    endpoints = [endpoint() for _ in range(3)]
    transports = [
        opening(robot, listen=[where], connect=endpoints[:1], key=KEY)
        for robot, where in enumerate(endpoints)
    ]
    wait_until_connected(transports)
    assert [transport.n_neighbours for transport in transports] == [2, 2, 2]


def test_robots_relay_between_robots_out_of_reach(opening, tmp_path):
    """The two outer robots connect to the middle one and do not listen."""
    (tmp_path / "relay.json5").write_text("{ mode: 'router', listen: { endpoints: [] } }")
    where, options = endpoint(), {"config": tmp_path / "relay.json5", "key": KEY}
    left, right = (opening(robot, connect=[where], **options) for robot in (0, 2))
    middle = opening(1, listen=[where], **options)
    greet([left, middle, right])
    assert [each.n_neighbours for each in (left, middle, right)] == [1, 2, 1]


def test_teams_with_other_names_are_separate(opening):
    where = endpoint()
    middle = opening(0, listen=[where], key=KEY)
    others = opening(1, "others", connect=[where], key=KEY)
    mate = opening(2, connect=[where], key=KEY)
    until(lambda: others.n_neighbours == 1)
    wait_until_connected([middle, mate])
    assert others.received == Traffic()
    others.send(1, [b"x"], 0.0, "maps")
    mate.send(2, [b"y"], 0.0, "maps")
    assert heard(middle, 1) == [(2, b"y")]


# -- foreign datagrams -----------------------------------------------------------------------------


def test_hostile_frames_are_counted_and_the_team_continues(opening, stranger):
    where = endpoint()
    a = opening(0, listen=[where], key=KEY)
    b = opening(1, connect=[where], key=KEY)
    frames: list[bytes] = []
    session = stranger(where)
    session.declare_subscriber("gmmtorch/team/1", lambda sample: frames.append(sample.payload.to_bytes()))
    wait_until_connected([a, b])
    until(lambda: b.send(1, [b"one"], 0.0, "maps") or len(frames) > 0)
    b.send(1, [b"two"], 0.0, "maps")
    until(lambda: (1, b"two") in a.deliver(0, 0.0))
    hostile = hostile_frames(frames[0], sender=5)
    before = a.received
    waits = {"congestion_control": zenoh.CongestionControl.BLOCK}
    for number, payloads in enumerate(hostile.values()):
        for payload in payloads:
            session.put(f"gmmtorch/team/{number}", payload, **waits)
    session.delete("gmmtorch/team/7", **waits)
    session.put("gmmtorch/team/\n\u2028" + "x" * 3000, b"hello", **waits)
    session.put("gmmtorch/team/7", bytes(10_000_000), **waits)
    session.put("gmmtorch/team/7", Sealer(7, KEY).seal(b"by one who has the key"), **waits)
    until(lambda: (7, b"by one who has the key") in a.deliver(0, 0.0))
    counts = {reason: len(payloads) for reason, payloads in hostile.items()}
    counts["foreign"] += 2  # a deletion has an empty payload
    assert {reason: n for reason, n in a.refused.items() if n} == counts
    assert a.received.datagrams - before.datagrams == sum(counts.values()) + 1
    b.send(1, [b"three"], 0.0, "maps")
    assert heard(a, 1) == [(1, b"three")]


# -- connecting and restarting ---------------------------------------------------------------------


def test_a_lonely_robot_continues_and_connects_later(opening):
    endpoints = [endpoint(), endpoint()]
    a = opening(0, listen=endpoints[:1], connect=endpoints[1:], key=KEY)
    a.send(0, [b"nobody hears this"], 0.0, "maps")
    assert (a.n_neighbours, a.deliver(0, 0.0), a.failures) == (0, [], {})
    assert Radio(0, a, announce_every=1.0).warnings(0) == ", no robot connected"
    b = opening(1, listen=endpoints[1:], key=KEY)
    wait_until_connected([a, b])
    a.send(0, [b"this is heard"], 0.0, "maps")
    assert heard(b, 1) == [(0, b"this is heard")]
    assert Radio(0, a, announce_every=1.0).warnings(0) == ""
    assert (a.books(0)["neighbours"], a.books(0)["session"]) == (1, a.session.hex())


def test_a_restarted_robot_is_received_again(opening):
    endpoints = [endpoint(), endpoint()]
    a, b = team(opening, endpoints, key=KEY)
    b.close()
    until(lambda: a.n_neighbours == 0)
    a.send(0, [b"nobody hears this"], 0.0, "maps")
    again = opening(1, listen=endpoints[1:], connect=endpoints[:1], key=KEY)
    wait_until_connected([a, again])
    again.send(1, [b"after"] * 5, 0.0, "maps")
    assert heard(a, 5) == [(1, b"after")] * 5
    assert sum(a.refused.values()) == 0


OTHER_ROBOT = """
import json, os, sys, time, zenoh
from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
aead = ChaCha20Poly1305(bytes(range(32)))
config = zenoh.Config()
config.insert_json5("connect/endpoints", json.dumps([sys.argv[1]]))
config.insert_json5("scouting/multicast/enabled", "false")
session, life, number = zenoh.open(config), os.urandom(8), 0
subscriber = session.declare_subscriber("gmmtorch/team/0")
for sample in subscriber:
    frame = sample.payload.to_bytes()
    datagram = aead.decrypt(frame[3:15], frame[15:], frame[:15])
    header = b"\\xf1" + (7).to_bytes(2, "little") + life + number.to_bytes(4, "little")
    session.put("gmmtorch/team/7", header + aead.encrypt(header[3:], datagram[::-1], header))
    number += 1
    if datagram == b"end":
        break
session.close()
"""


def test_a_program_written_from_the_docs_takes_part(opening):
    """It follows docs/network.md and has none of our code."""
    where = endpoint()
    a = opening(0, listen=[where], key=KEY)
    with subprocess.Popen([sys.executable, "-c", OTHER_ROBOT, where]) as other:
        until(lambda: a.send(0, [b"hello"], 0.0, "maps") or len(a.deliver(0, 0.0)) > 0)
        sent = [f"datagram {i}".encode() for i in range(50)]
        a.send(0, [*sent, b"end"], 0.0, "maps")
        answers = [datagram for datagram in said_until(a, b"dne") if datagram != b"olleh"]
        assert answers == [datagram[::-1] for datagram in [*sent, b"end"]]
        assert other.wait(20) == 0


def said_until(transport: ZenohTransport, last: bytes) -> list[bytes]:
    said: list[bytes] = []
    until(lambda: said.extend(d for _, d in transport.deliver(transport.robot, 0.0)) or said[-1:] == [last])
    return said


FORGETFUL = """
import sys
from gmmtorch.team.sharing.transport.zenoh_transport import ZenohTransport
transport = ZenohTransport(1, connect=[sys.argv[1]])
while not transport.deliver(1, 0.0):
    transport.send(1, [b"x"], 0.0, "maps")
sys.exit(5)
"""


@pytest.mark.slow
def test_a_process_that_does_not_close_ends(opening):
    where = endpoint()
    a = opening(0, listen=[where])
    with subprocess.Popen([sys.executable, "-c", FORGETFUL, where]) as other:
        # The process ends when it receives a datagram, which is sent after its own was received.
        until(lambda: (1, b"x") in a.deliver(0, 0.0))
        until(lambda: a.send(0, [b"end"], 0.0, "maps") or other.poll() is not None)
        assert other.returncode == 5
    until(lambda: a.n_neighbours == 0)


def test_close_releases_port_and_thread_and_may_be_repeated():
    n_threads, where = threading.active_count(), endpoint()
    with ZenohTransport(0, listen=[where]) as transport:
        assert threading.active_count() == n_threads + 1
        assert "0" in threading.enumerate()[-1].name
    transport.close()
    assert threading.active_count() == n_threads
    assert transport.n_neighbours == 0
    for use in (lambda: transport.send(0, [b"x"], 0.0, "maps"), lambda: transport.deliver(0, 0.0)):
        with pytest.raises(GmmTorchError, match="closed"):
            use()
    ZenohTransport(1, listen=[where]).close()


def test_datagrams_that_zenoh_refuses_are_counted(opening, caplog):
    a = opening(0, listen=[endpoint()], key=KEY)
    a._session.close()
    for _ in range(3):
        a.send(0, [b"x", b"y"], 0.0, "maps")
    assert a.failures == {"ZError": 6}
    assert (a.sent, a.traffic()) == (Traffic(), Traffic(6, 6))
    assert len(caplog.messages) == 1
