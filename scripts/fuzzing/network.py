"""Readers of what comes from a network: datagrams and stores of teams, the UDP transport, the viewer."""

from __future__ import annotations

import contextlib
import functools
import os
import random
import shutil
import socket
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from fuzzing.hostile_bytes import changed, mended_datagram
from fuzzing.target import Target, taken

import gmmtorch as gt


def sharing(scans: list[Any]) -> dict[str, Target]:
    """Datagrams and frames of teams, codes of points, and stores."""
    from mapping.random_components import around_a_sensor
    from sharing.message_examples import channel_examples, examples
    from sharing.structured_bodies import structured

    from gmmtorch.team.sharing import POINT_CODECS, Replica, Store, TeamKey, ViewLibrary, ViewsMessage, decode
    from gmmtorch.team.sharing.messages.component_messages import encode_components
    from gmmtorch.team.sharing.messages.datagrams import Kind
    from gmmtorch.team.sharing.point_codecs import point_codec
    from gmmtorch.team.sharing.transport.security import Opener, Sealer

    replica = Replica(1)
    built = gt.GaussianMap()
    for scan in scans:
        built.insert(scan)
    built.finish()
    replica.add(built.components())
    packets = [*replica.datagrams(1_200)[:8], *examples(), *channel_examples()]
    packets += encode_components(around_a_sensor(40))
    listeners: dict[str, Any] = {}

    def receive(data: bytes) -> None:
        """A robot that has heard the datagrams before; now and then a new one."""
        if listeners.get("n", 0) % 500 == 0:
            listeners.update(replica=Replica(2, incarnation=1, most_components=20_000), views=ViewLibrary(2))
        listeners["n"] = listeners.get("n", 0) + 1
        listeners["replica"].receive(data)
        message = decode(data)
        if isinstance(message, ViewsMessage):
            listeners["views"].receive(message, 0.0)

    def formed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
        """A changed datagram, or one that follows its format with extreme numbers."""
        return structured(rng.choice(list(Kind)), rng) if rng.random() < 0.5 else changed(data, others, rng)

    key = TeamKey.generate()
    sealers = [Sealer(1, key), Sealer(1, None)]

    def framed(data: bytes, others: list[bytes], rng: random.Random) -> bytes:
        """A changed datagram in a sound frame, or a changed frame."""
        frame = rng.choice(sealers).seal(mended_datagram(formed(data, others, rng))[:1200])
        return frame if rng.random() < 0.7 else changed(frame, others, rng)

    def open_frame(path: Path) -> None:
        if "openers" not in listeners:
            listeners["openers"] = [Opener(key), Opener(None)]
        for opener in listeners["openers"]:
            opened = opener.open(path.read_bytes(), "127.0.0.1:1")
            if opened is not None:
                receive(opened[1])

    codecs = {name: point_codec(name, 0.1, 0.01) for name in POINT_CODECS}
    ends = torch.rand(20, 3, dtype=torch.float64)

    def restore(path: Path) -> None:
        with tempfile.TemporaryDirectory(dir=path.parent.parent) as place:
            shutil.copy(path, place)
            with Store(Path(place) / path.name, robot=1) as store:
                store.restore(Replica(1))
                store.progress()

    with tempfile.TemporaryDirectory() as place:
        with Store(Path(place) / "a.store", robot=1) as store:
            own = Replica(1)
            store.restore(own)
            own.add(built.components())
            store.keep(own.datagrams())
            store.save_progress(1, {"x": torch.ones(3)})
        stored = taken(Path(place), "a.store")
    numbered = {f"{i}.packet": one for i, one in enumerate(packets)}
    return {
        "datagrams": Target(numbered, lambda path: receive(path.read_bytes()), mended_datagram, formed),
        "frames": Target(numbered, open_frame, change=framed),
        "point codes": Target(
            {f"a.{name}": codec.encode(ends) for name, codec in codecs.items()},
            lambda path: codecs[path.suffix[1:]].decode(path.read_bytes()),
        ),
        "stores": Target(stored, restore),
    }


# -- sockets: one for each process; its thread is tried again after each input -------------------------


def sockets() -> dict[str, Target]:
    """The UDP transport and the viewer, each asked again after each input whether it still works."""
    found = {
        "udp": Target(
            {"frame": b"\xe1" + bytes(40), "empty": b""}, functools.partial(_to_udp, {}), has_thread=True
        )
    }
    with contextlib.suppress(ImportError):
        import viser

        import gmmtorch.live.map_viewer  # noqa: F401

        upgrade = (
            b"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: viser-v"
            + viser.__version__.encode()
            + b"\r\n"
        )
        host = b"Host: 127.0.0.1:8080\r\n"
        message = (
            b"\x83\xa4type\xb3ViewerCameraMessage\xa4wxyz\x94\xcb" + bytes(8) + b"\x00\x00\x00\xa3fov\x01"
        )
        seeds = {
            "get": b"GET / HTTP/1.1\r\n" + host + b"Accept-Encoding: gzip\r\nIf-None-Match: x\r\n\r\n",
            "path": b"GET /../../../etc/passwd HTTP/1.1\r\n" + host + b"\r\n",
            "socket": b"GET / HTTP/1.1\r\n" + host + upgrade + b"Origin: http://127.0.0.1:8080\r\n\r\n",
            "message": b"GET / HTTP/1.1\r\n" + host + upgrade + b"\r\n" + _websocket_frame(message),
        }
        found["viewer"] = Target(seeds, functools.partial(_to_viewer, {}), has_thread=True)
    return found


def _websocket_frame(payload: bytes) -> bytes:
    """A binary frame of a client (RFC 6455), whose mask changes nothing."""
    return b"\x82" + bytes([0x80 | len(payload)]) + bytes(4) + payload


def _to_udp(kept: dict[str, Any], path: Path) -> None:
    from gmmtorch.team.sharing import UdpTransport

    if not kept:
        kept.update(to=UdpTransport.unicast(1), by=socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    transport, data = kept["to"], path.read_bytes()[:60_000]
    before = transport.received.datagrams
    kept["by"].sendto(data, transport.address)
    end = time.monotonic() + 5
    while transport.received.datagrams == before:
        if time.monotonic() > end:
            raise RuntimeError("the transport no longer receives")
        time.sleep(0)
    transport.deliver(1, 0.0)


def _to_viewer(kept: dict[str, Any], path: Path) -> None:
    from gmmtorch.live.map_viewer import MapViewer

    if not kept:
        place = MapViewer(gt.GaussianMap(), port=20_000 + os.getpid() % 40_000).server.get_port()
        kept["place"] = "127.0.0.1", place
    own = f"127.0.0.1:{kept['place'][1]}".encode()
    sound = b"GET /nothing HTTP/1.1\r\nHost: " + own + b"\r\n\r\n"
    hostile, received = path.read_bytes().replace(b"127.0.0.1:8080", own), b""
    for data, wanted in ((hostile, False), (sound, True)):
        with socket.create_connection(kept["place"], timeout=5) as connection:
            connection.sendall(data)
            connection.settimeout(0.01 if not wanted else 5)
            with contextlib.suppress(ConnectionError, TimeoutError):
                received = connection.recv(4096)
        if wanted and not received.startswith(b"HTTP/1.1 "):
            raise RuntimeError(f"the viewer no longer answers: {received[:60]!r}")
