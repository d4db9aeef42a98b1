"""Zenoh transport: real sessions on loopback without scouting; endpoints, settings and foreign datagrams."""

from __future__ import annotations

import datetime
import ipaddress
import json
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import pytest
from sharing.transport_cases import KEY, Heard, heard, hostile_frames, until

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.team.sharing import Radio, Transport, ZenohTransport
from gmmtorch.team.sharing.transport import zenoh_transport
from gmmtorch.team.sharing.transport.security import Sealer
from gmmtorch.team.sharing.transport.simulated_network import Traffic

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


@pytest.fixture
def opening() -> Iterator[Callable[..., ZenohTransport]]:
    """Opens Zenoh transports, which are closed after the test."""
    with ExitStack() as stack:
        yield lambda robot, *a, **options: stack.enter_context(ZenohTransport(robot, *a, **options))


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


def test_without_a_key_only_loopback_is_allowed(opening, tmp_path):
    (tmp_path / "zenoh.json5").write_text("{ listen: { endpoints: ['tcp/0.0.0.0:0'] } }")
    for options in (
        {"listen": ["tcp/0.0.0.0:0"]},
        {"listen": ["tcp/[::]:0"]},
        {"listen": ["udp/224.0.0.224:7446"]},
        {"connect": ["tcp/127.0.0.1:7447", "tcp/198.51.100.7:7447"]},
        {"connect": ["tls/localhost.example:7447"]},
        {"connect": ["serial/dev/ttyUSB0"]},
        {"scouting": True},
        {"config": tmp_path / "zenoh.json5"},
    ):
        with pytest.raises(InvalidArgumentError, match=r"no key.*insecure=True"):
            opening(0, **options)
    for options in ({"key": KEY}, {"insecure": True}):
        opening(0, listen=["tcp/0.0.0.0:0"], **options)
        opening(0, config=tmp_path / "zenoh.json5", **options)
    opening(0, connect=["tcp/127.0.0.2:7447", "udp/[::1]:7447", "tcp/localhost:7447"])


def test_a_port_in_use_is_reported_with_the_remedy(opening):
    where = endpoint()
    opening(0, listen=[where])
    with pytest.raises(InvalidArgumentError, match=rf"{where}.*another process.*another port"):
        opening(1, listen=[where])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"robot": 65536}, "sender=65536"),
        ({"team": ""}, "team=''"),
        ({"team": "a/b"}, "team='a/b'"),
        ({"team": "*"}, "team="),
        ({"listen": "tcp/127.0.0.1:0"}, "list of endpoints"),
        ({"listen": ["127.0.0.1:7447"]}, "must be an endpoint"),
        ({"listen": [7447]}, "listen=7447"),
        ({"listen": ["tcp/127.0.0.1"]}, "must be an endpoint"),
        ({"listen": ["tcp/127.0.0.1:65536"]}, "65535"),
        ({"listen": ["tcp/198.51.100.7:0"], "key": KEY}, "no such address"),
        ({"listen": ["pigeon/home"], "key": KEY}, "pigeon"),
        ({"connect": ["tcp/127.0.0.1:0"]}, "port 1"),
        ({"connect": [""]}, "connect=''"),
        ({"listen": []}, "No robot is reached"),
        ({"max_waiting": 0}, "max_waiting=0"),
    ],
)
def test_invalid_options_are_named(options, message):
    n_threads = threading.active_count()
    with pytest.raises(InvalidArgumentError, match=message):
        ZenohTransport(**{"robot": 0, "listen": ["tcp/127.0.0.1:0"], **options})
    assert threading.active_count() == n_threads


def test_invalid_configurations_are_named(tmp_path):
    with pytest.raises(MissingDataError, match="nowhere"):
        ZenohTransport(0, config=tmp_path / "nowhere.json5", key=KEY)
    for text, message in (
        ("{ mode: 'peer'", "no configuration"),
        ("{ mode: 'peer', wings: 2 }", "wings"),
        ("{ mode: 'client' }", "mode 'client'.*router"),
    ):
        (tmp_path / "zenoh.json5").write_text(text)
        with pytest.raises(DataError, match=message):
            ZenohTransport(0, config=tmp_path / "zenoh.json5", key=KEY)


def test_zenoh_configuration_may_use_tls(opening, tmp_path):
    certify(tmp_path)
    names = {"root_ca_certificate": "cert.pem", "enable_mtls": True}
    for side in ("listen", "connect"):
        names |= {f"{side}_certificate": "cert.pem", f"{side}_private_key": "key.pem"}
    tls = {name: value if value is True else str(tmp_path / value) for name, value in names.items()}
    (tmp_path / "zenoh.json5").write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    where = endpoint("tls")
    a = opening(0, listen=[where], config=tmp_path / "zenoh.json5", key=KEY)
    b = opening(1, connect=[where], config=tmp_path / "zenoh.json5", key=KEY)
    wait_until_connected([a, b])
    assert {link.dst.partition("/")[0] for link in b._session.info.links()} == {"tls"}
    with socket.create_connection(("127.0.0.1", int(where.rpartition(":")[2]))) as without_certificate:
        without_certificate.sendall(b"hello")
    a.send(0, [b"x"], 0.0, "maps")
    assert heard(b, 1) == [(0, b"x")]


def certify(folder: Path) -> None:
    """A key, and a self-signed certificate for 127.0.0.1."""
    x509 = pytest.importorskip("cryptography.x509")
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    private, now = ec.generate_private_key(ec.SECP256R1()), datetime.datetime.now(datetime.UTC)
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "robots")])
    address = x509.SubjectAlternativeName([x509.IPAddress(ipaddress.ip_address("127.0.0.1"))])
    builder = x509.CertificateBuilder(
        name, name, private.public_key(), 1, now, now + datetime.timedelta(days=1)
    )
    certificate = builder.add_extension(address, critical=False).sign(private, hashes.SHA256())
    (folder / "cert.pem").write_bytes(certificate.public_bytes(serialization.Encoding.PEM))
    (folder / "key.pem").write_bytes(
        private.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )


class Listening:
    """A publisher that records its frames."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self.reliability, self.frames = publisher.reliability, list[bytes]()
        self.put = self.frames.append


def test_only_repeated_kinds_are_best_effort(opening):
    a = opening(0, listen=[endpoint()])
    ways = a._best_effort, a._reliable = Listening(a._best_effort), Listening(a._reliable)
    for kind in ("plans", "announcements", "components", "counts", "points", "views", "anything"):
        a.send(0, [kind.encode()], 0.0, kind)
    said = {str(way.reliability): [frame[a.overhead :] for frame in way.frames] for way in ways}
    assert said == {
        str(zenoh.Reliability.BEST_EFFORT): [b"plans", b"announcements"],
        str(zenoh.Reliability.RELIABLE): [b"components", b"counts", b"points", b"views", b"anything"],
    }


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(GmmTorchError, match=r"pip install 'gmmtorch\[zenoh\]'"):
        ZenohTransport(0, listen=["tcp/127.0.0.1:0"])


@pytest.mark.parametrize("name", ["declare_publisher", "declare_subscriber"])
def test_an_unusable_session_is_closed(monkeypatch, name):
    sessions = []

    class Refusing:
        """A session that cannot publish or subscribe."""

        def __init__(self, session: zenoh.Session) -> None:
            self._session = session
            sessions.append(session)

        def __getattr__(self, asked: str) -> object:
            return self._refuse if asked == name else getattr(self._session, asked)

        def _refuse(self, *_: object, **__: object) -> None:
            raise zenoh.ZError("denied")

    opened = zenoh_transport.open_session
    monkeypatch.setattr(zenoh_transport, "open_session", lambda *a: Refusing(opened(*a)))
    n_threads = threading.active_count()
    with pytest.raises(GmmTorchError, match=r"robot 3 publish at gmmtorch/team/3.*denied.*config"):
        ZenohTransport(3, listen=[endpoint()], key=KEY)
    assert [session.is_closed() for session in sessions] == [True]
    assert threading.active_count() == n_threads
