"""Datagrams that only a team can read and write: sealed with its key, and opened again.

ChaCha20-Poly1305 (RFC 8439) of the package cryptography. What goes on the wire, byte by byte, and what it
protects from: docs/network.md.
"""

from __future__ import annotations

import logging
import os
import secrets
import threading
import time
from collections.abc import Callable
from typing import NoReturn

from gmmtorch.errors import GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.sharing.messages.envelope import MAX_BYTES
from gmmtorch.sharing.transport.sessions import Sessions, TwinWatch
from gmmtorch.sharing.transport.team_key import TeamKey

__all__ = ["REFUSALS", "Opener", "Sealer", "TeamKey"]

FRAME_VERSION = 1
MAX_SENDER = (1 << 16) - 1
SESSION_BYTES = 8
PLAIN_OVERHEAD = 15
"""Bytes that a frame without a key adds: first byte, sender (2), session (8), number (4)."""
TAG_BYTES = 16
SEALED_OVERHEAD = PLAIN_OVERHEAD + TAG_BYTES
"""Bytes that a frame with a key adds. 1200 + 31 + 48 of IPv6 and UDP are 1279; any path takes 1280."""
REFUSALS = ("oversized", "foreign", "version", "malformed", "wrong_key", "echo", "replayed", "namesake")
"""Why a frame is refused, in the order in which it is asked."""
_PLAIN, _SEALED = 14, 15  # high half of the first byte; the low half is the version
_NUMBERS = 1 << 32
_MAX_SAID = 16
_NEWS = {
    "wrong_key": (
        "Datagrams from {source} that say they are of robot {sender} do not open: they are sealed with "
        "another key, or only one side has a key, or they were altered. Give all robots the same team key."
    ),
    "version": (
        f"Frames from {{source}} are not of version {FRAME_VERSION}, which this gmmtorch reads. Update it "
        "on one of the robots."
    ),
    "namesake": (
        "Two robots have the number {sender}, heard from {pair}: what they say is refused. Give each robot "
        "its own number."
    ),
}
_log = logging.getLogger(__name__)


class _Cipher:
    """ChaCha20-Poly1305 with a team's key."""

    def __init__(self, key: TeamKey) -> None:
        try:
            from cryptography.exceptions import InvalidTag
            from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
        except ImportError as error:
            raise GmmTorchError(
                f"Datagrams are sealed with the package cryptography, which does not load ({error}); "
                "pip install 'gmmtorch[network]'."
            ) from error
        self._aead, self._invalid = ChaCha20Poly1305(key._data), InvalidTag

    def encrypt(self, header: bytes, datagram: bytes) -> bytes:
        return self._aead.encrypt(_nonce(header), datagram, header)

    def decrypt(self, header: bytes, data: bytes) -> bytes | None:
        """The datagram, or None where key, header or data are not those it was sealed with."""
        try:
            return self._aead.decrypt(_nonce(header), data, header)
        except self._invalid:
            return None


def _nonce(header: bytes) -> bytes:
    """Session and number, 12 bytes: under one key no two datagrams have the same."""
    return header[3:]


class Sealer:
    """Frames one robot's datagrams: sealed with the team's key, or in the clear without one.

    A frame carries its sender, a session and a number, which make its nonce. The session is 64 bits drawn at
    random at each start; the number counts from zero. No nonce comes twice: after 2³² datagrams, and
    in a process forked off, a new session is drawn. Threads may share a sealer.
    """

    def __init__(self, sender: int, key: TeamKey | None = None) -> None:
        if check_whole("sender", sender, 0) > MAX_SENDER:
            raise InvalidArgumentError(f"sender={sender} must be at most {MAX_SENDER}.")
        self.sender = int(sender)
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
        if not isinstance(datagram, bytes) or len(datagram) > MAX_BYTES:
            size = f"{len(datagram)} bytes" if isinstance(datagram, bytes) else type(datagram).__name__
            raise InvalidArgumentError(f"A datagram is {size}; it must be bytes, {MAX_BYTES} at most.")
        with self._lock:
            if self._number == _NUMBERS or self._process != os.getpid():
                self._begin()
            header = self._first + self.sender.to_bytes(2, "little") + self.session
            header += self._number.to_bytes(4, "little")
            self._number += 1
        return header + (datagram if self._cipher is None else self._cipher.encrypt(header, datagram))

    def __reduce__(self) -> NoReturn:
        raise InvalidArgumentError("A Sealer is not copied: two of one session would share nonces.")


class Opener:
    """Opens the frames that other robots have sealed; counts, and refuses, whatever else comes in.

    Not for several threads at once.
    """

    def __init__(
        self,
        key: TeamKey | None = None,
        own: Sealer | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """Args:
        key: what the others seal with, or None if they do not.
        own: this robot's, so that what comes back to it, and others with its number, are known.
        clock: seconds that never go back.
        """
        self._cipher = None if key is None else _Cipher(key)
        self._own = own
        self._form = _PLAIN if key is None else _SEALED
        self._sessions = Sessions(clock)
        self._twins = TwinWatch(clock)
        self._said: set[tuple[str, int]] = set()
        self.former: frozenset[bytes] = frozenset()
        """Sessions of former starts of this robot: whoever speaks in them plays back what it said."""
        self.refused = dict.fromkeys(REFUSALS, 0)
        """How many frames were refused, by reason."""

    @property
    def namesakes(self) -> dict[int, str]:
        """Numbers that two robots have, and the addresses and sessions they were heard from. This robot's own
        stays."""
        return dict(self._sessions.namesakes)

    def open(self, frame: bytes, source: str = "") -> tuple[int, bytes] | None:
        """(sender, datagram), or None for what is refused: any bytes may be given, none raise an error.

        `source`: the address it came from, for the log alone. The log tells the first of each kind.
        """
        sender, datagram, reason = self._examined(frame, source)
        if reason is None:
            return sender, datagram
        self.refused[reason] += 1
        self._say(reason, sender, source)
        return None

    def _examined(self, frame: bytes, source: str) -> tuple[int, bytes, str | None]:
        """Sender, datagram, and why it is refused; sender −1 where nobody can tell."""
        reason = _misfit(frame)
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
        whence = f"{source} (session {session.hex()})"  # which is in that robot's log, too
        if own is not None and sender == own.sender:
            if session not in self.former and self._twins.finds(session, number):
                self._sessions.namesakes[sender] = f"{whence} and this robot (session {own.session.hex()})"
            return sender, datagram, "namesake"
        return sender, datagram, self._sessions.refusal(sender, session, number, whence)

    def _say(self, reason: str, sender: int, source: str) -> None:
        """Log what somebody has to mend, once; and not much in all, whoever asks for it."""
        if reason not in _NEWS or (reason, sender) in self._said or len(self._said) >= _MAX_SAID:
            return
        if reason == "namesake" and sender not in self._sessions.namesakes:
            return  # of a former life of this robot, for all that is known yet
        self._said.add((reason, sender))
        pair = self._sessions.namesakes.get(sender, source)
        _log.warning(_NEWS[reason].format(sender=sender, source=source or "somewhere", pair=pair))


def _misfit(frame: bytes) -> str | None:
    """Why bytes cannot be a frame of this version, by what they look like."""
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
