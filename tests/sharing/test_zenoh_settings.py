"""Endpoints and settings of the Zenoh transport: keys, ports, configuration files and TLS."""

from __future__ import annotations

import datetime
import ipaddress
import json
import socket
import sys
import threading
from pathlib import Path

import pytest
from sharing.transport_cases import KEY, heard
from sharing.zenoh_cases import endpoint, wait_until_connected, zenoh

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.team.sharing.transport import zenoh_transport
from gmmtorch.team.sharing.transport.zenoh_transport import ZenohTransport


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
        ({"robot": -1}, "sender=-1"),
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
