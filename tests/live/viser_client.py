"""A client of the browser viewer: a page without a browser, by its WebSocket."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import msgspec.msgpack
import viser
import zstandard
from viser._messages import ViewerCameraMessage
from websockets.sync.client import ClientConnection, connect

_CAMERA = ViewerCameraMessage(
    wxyz=(1.0, 0.0, 0.0, 0.0),
    position=(0.0, 0.0, 0.0),
    fov=1.3,
    near=0.01,
    far=1000.0,
    image_height=700,
    image_width=1000,
    look_at=(0.0, 0.0, 1.0),
    up_direction=(0.0, 0.0, 1.0),
)


class Client:
    """Connects as a page does; use it in a `with` statement. Leaving without `close` cuts the connection."""

    def __init__(self, url: str, **headers: Any) -> None:
        self._connection: ClientConnection = connect(
            url.replace("http", "ws"),
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            max_size=None,
            max_queue=None,  # reads even while nobody takes what it received
            ping_interval=None,
            **headers,
        )
        self._decompress = zstandard.ZstdDecompressor().decompress
        self._connection.send(msgspec.msgpack.encode(_CAMERA.as_serializable_dict()))

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()

    def cut(self) -> None:
        """Ends the connection as a lost network does, without saying so."""
        self._connection.socket.close()

    def received(self, *names: bytes, seconds: float = 20.0) -> int:
        """The number of bytes until all names have been received."""
        missing, n_bytes, end = set(names), 0, time.monotonic() + seconds
        while missing:
            data = self._connection.recv(timeout=max(end - time.monotonic(), 0.01))
            assert isinstance(data, bytes)
            n_bytes += len(data)
            size, packed = (int.from_bytes(data[k : k + 8], "little") for k in (0, 8))
            text = self._decompress(data[16 : 16 + packed], max_output_size=size)
            missing = {name for name in missing if name not in text}
        return n_bytes


def wait_until(condition: Callable[[], object], seconds: float = 20.0) -> None:
    """Returns as soon as a condition is true."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.01)
