"""Encrypted frames: a team's datagrams, which only robots with the team's key can read and write.

Cipher: ChaCha20-Poly1305 (RFC 8439), from the package cryptography. docs/network.md describes the frame
byte by byte, and what it protects from.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.optional_packages import needs_extra
from gmmtorch.team.sharing.messages.envelope import MAX_BYTES, check_datagram
from gmmtorch.team.sharing.transport.sessions import OwnIdWatch, Sessions
from gmmtorch.team.sharing.transport.team_key import TeamKey

__all__ = ["REFUSALS", "Opener", "Sealer", "TeamKey"]

FRAME_VERSION = 1
MAX_SENDER = (1 << 16) - 1
SESSION_BYTES = 8
PLAIN_OVERHEAD = 15
"""Bytes that a frame without a key adds: first byte, sender (2), session (8), number (4)."""
TAG_BYTES = 16
SEALED_OVERHEAD = PLAIN_OVERHEAD + TAG_BYTES
"""Bytes that a frame with a key adds. 1200 + 31 + 48 (IPv6, UDP) = 1279; every path carries 1280."""
REFUSALS = ("oversized", "foreign", "version", "malformed", "wrong_key", "echo", "replayed", "duplicate_id")
"""Reasons for which a frame is refused, in the order of the checks."""
_PLAIN, _SEALED = 14, 15  # high half of the first byte; the low half is the version
_NUMBERS = 1 << 32
_MAX_LOGGED = 16
_WARNINGS = {
    "wrong_key": (
        "Datagrams from {source} of robot {sender} cannot be opened: they are sealed with another key, or "
        "only one side has a key, or they were altered. Give all robots the same team key."
    ),
    "version": (
        f"Frames from {{source}} are not of version {FRAME_VERSION}, which this gmmtorch reads. Update it "
        "on one of the robots."
    ),
    "duplicate_id": (
        "Two robots use the id {sender}, at {pair}: their datagrams are refused. Give each robot an id of "
        "its own."
    ),
}
_log = logging.getLogger(__name__)


class _Cipher:
    """ChaCha20-Poly1305 with a team's key."""

    def __init__(self, key: TeamKey) -> None:
        with needs_extra("A team key needs", "cryptography", "network"):
            from cryptography.exceptions import InvalidTag
            from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
        self._aead, self._invalid = ChaCha20Poly1305(key._data), InvalidTag

    def encrypt(self, header: bytes, datagram: bytes) -> bytes:
        return self._aead.encrypt(_nonce(header), datagram, header)

    def decrypt(self, header: bytes, data: bytes) -> bytes | None:
        """The datagram; None if key, header or data differ from those that it was sealed with."""
        try:
            return self._aead.decrypt(_nonce(header), data, header)
        except self._invalid:
            return None


def _nonce(header: bytes) -> bytes:
    """Session and number, 12 bytes: unique for each datagram under one key."""
    return header[3:]


class Sealer:
    """Makes frames of one robot's datagrams: sealed with the team's key, or in the clear without one.

    A frame has its sender, a session and a number, which make its nonce. The session is 64 random bits,
    drawn at each start; the number counts from zero. No nonce is used twice: after 2³² datagrams, and in a
    forked process, a new session is drawn. Thread-safe.
    """

    def __init__(self, sender: int, key: TeamKey | None = None) -> None:
        self.sender = check_whole("sender", sender, 0, MAX_SENDER)
        self.overhead = PLAIN_OVERHEAD if key is None else SEALED_OVERHEAD
        self._cipher = None if key is None else _Cipher(key)
        self._first = bytes([(_PLAIN if key is None else _SEALED) << 4 | FRAME_VERSION])
        self._lock = threading.Lock()
        self._begin()

    def _begin(self) -> None:
        self.session = secrets.token_bytes(SESSION_BYTES)
        self._number, self._process = 0, os.getpid()

    def seal(self, datagram: bytes) -> bytes:
        """The frame of a datagram of at most 1200 bytes, `overhead` longer."""
        check_datagram(datagram)
        with self._lock:
            if self._number == _NUMBERS or self._process != os.getpid():
                self._begin()
            header = self._first + self.sender.to_bytes(2, "little") + self.session
            header += self._number.to_bytes(4, "little")
            self._number += 1
        return header + (datagram if self._cipher is None else self._cipher.encrypt(header, datagram))

    def __reduce__(self) -> NoReturn:
        raise InvalidArgumentError("A Sealer cannot be copied: two with one session would share nonces.")


class Opener:
    """Opens the frames of other robots; refuses and counts everything else.

    Not thread-safe.

    Attributes:
        former: sessions of former starts of this robot. Their frames are refused, but show no duplicate id.
        refused: number of frames refused, by reason (`REFUSALS`).
    """

    def __init__(
        self,
        key: TeamKey | None = None,
        own: Sealer | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Args:
        key: the team's key; None if frames are in the clear.
        own: this robot's sealer, to recognize its own frames, and other robots with its id.
        clock: seconds that never go back.
        """
        self._cipher = None if key is None else _Cipher(key)
        self._own = own
        self._form = _PLAIN if key is None else _SEALED
        self._sessions = Sessions(clock)
        self._own_id = OwnIdWatch(clock)
        self._logged: set[tuple[str, int]] = set()
        self.former: frozenset[bytes] = frozenset()
        self.refused = dict.fromkeys(REFUSALS, 0)

    @property
    def duplicates(self) -> dict[int, str]:
        """Robot ids that two robots use, with the addresses and sessions of both. This robot's own id
        stays."""
        return dict(self._sessions.duplicates)

    def open(self, frame: bytes, source: str = "") -> tuple[int, bytes] | None:
        """(sender, datagram), or None if the frame is refused. Never raises, for any bytes.

        source: the address that the frame came from, for the log. The first refusal of each kind is logged.
        """
        sender, datagram, reason = self._examined(frame, source)
        if reason is None:
            return sender, datagram
        self.refused[reason] += 1
        self._warn(reason, sender, source)
        return None

    def _examined(self, frame: bytes, source: str) -> tuple[int, bytes, str | None]:
        """Sender (−1 if unknown), datagram, and why it is refused."""
        reason = _malformed(frame)
        if reason is not None:
            return -1, b"", reason
        header, data = frame[:PLAIN_OVERHEAD], frame[PLAIN_OVERHEAD:]
        sender, session = int.from_bytes(header[1:3], "little"), header[3:11]
        if header[0] >> 4 != self._form:
            return sender, b"", "wrong_key"
        own = self._own
        if own is not None and (sender, session) == (own.sender, own.session):
            return sender, b"", "echo"
        datagram = data if self._cipher is None else self._cipher.decrypt(header, data)
        if datagram is None:
            return sender, b"", "wrong_key"
        number = int.from_bytes(header[11:], "little")
        address = f"{source} (session {session.hex()})"  # the log of that robot shows its session, too
        if own is not None and sender == own.sender:
            if session not in self.former and self._own_id.detects(session, number):
                self._sessions.duplicates[sender] = f"{address} and this robot (session {own.session.hex()})"
            return sender, datagram, "duplicate_id"
        return sender, datagram, self._sessions.refusal(sender, session, number, address)

    def _warn(self, reason: str, sender: int, source: str) -> None:
        """Log a refusal that a user can mend: once for each reason and sender, `_MAX_LOGGED` in all."""
        if reason not in _WARNINGS or (reason, sender) in self._logged or len(self._logged) >= _MAX_LOGGED:
            return
        if reason == "duplicate_id" and sender not in self._sessions.duplicates:
            return  # it may come from a former start of this robot
        self._logged.add((reason, sender))
        pair = self._sessions.duplicates.get(sender, source)
        _log.warning(_WARNINGS[reason].format(sender=sender, source=source or "somewhere", pair=pair))


def _malformed(frame: bytes) -> str | None:
    """Why bytes cannot be a frame of this version, by their form and length; None if they can."""
    if len(frame) > MAX_BYTES + SEALED_OVERHEAD:
        return "oversized"
    form, version = (frame[0] >> 4, frame[0] & 15) if frame else (0, 0)
    if form not in (_PLAIN, _SEALED):
        return "foreign"
    if version != FRAME_VERSION:
        return "version"
    overhead = PLAIN_OVERHEAD if form == _PLAIN else SEALED_OVERHEAD
    if len(frame) > MAX_BYTES + overhead:
        return "oversized"
    return "malformed" if len(frame) < overhead else None
