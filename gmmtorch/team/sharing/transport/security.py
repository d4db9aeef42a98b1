"""Encrypted frames: a team's datagrams, which only robots with the team's key can read and write.

Cipher: ChaCha20-Poly1305 (RFC 8439), from the package cryptography. docs/network.md describes the frame
byte by byte, and what it protects from.
"""

from __future__ import annotations

import logging
import os
import secrets
import stat
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError, check_whole
from gmmtorch.optional_packages import needs_extra
from gmmtorch.team.sharing.messages.datagrams import MAX_BYTES, check_datagram

KEY_BYTES = 32
KEY_VARIABLE = "GMMTORCH_TEAM_KEY"
"""Environment variable that may contain the key."""
_HELP = f"A key is {KEY_BYTES} bytes as {2 * KEY_BYTES} hexadecimal digits: `openssl rand -hex 32`."


class TeamKey:
    """The secret that all robots of a team share. Neither `repr` nor any error shows it."""

    __slots__ = ("_data",)

    def __init__(self, data: bytes) -> None:
        """`data`: 32 random bytes."""
        if not isinstance(data, bytes) or len(data) != KEY_BYTES:
            what = f"{len(data)} bytes" if isinstance(data, bytes) else f"of type {type(data).__name__}"
            raise InvalidArgumentError(f"The team key is {what}; it must be {KEY_BYTES} bytes.")
        self._data = data

    @classmethod
    def generate(cls) -> TeamKey:
        """A new key, from the operating system's random numbers."""
        return cls(secrets.token_bytes(KEY_BYTES))

    @classmethod
    def from_file(cls, path: str | Path) -> TeamKey:
        """The key in a file of 64 hexadecimal digits that only its owner may read. Raises `MissingDataError`
        if there is no file, and `DataError` if it contains something else, or if other users may read or
        write it."""
        path = Path(path)
        try:
            if not path.is_file():
                raise MissingDataError(
                    f"The team key {path} {'is no file' if path.exists() else 'does not exist'}. Copy the "
                    f"team's key there, or make one: `(umask 077; openssl rand -hex 32 > {path})`."
                )
            with path.open("rb") as file:
                mode = stat.S_IMODE(os.fstat(file.fileno()).st_mode)
                data = file.read(1024)
        except MissingDataError:
            raise
        except OSError as error:
            raise DataError(f"The team key {path} cannot be read: {error.strerror}.") from None
        if os.name == "posix" and mode & 0o077:
            raise DataError(
                f"The team key {path} has mode {mode:o}: other users than its owner may read or write it. "
                f"`chmod 600 {path}`; if others have used this machine, make a new key."
            )
        return cls._from_hex(data, f"The team key {path}")

    @classmethod
    def from_environment(cls) -> TeamKey:
        """The key in `KEY_VARIABLE`, as 64 hexadecimal digits. Raises as `from_file` does."""
        text = os.environ.get(KEY_VARIABLE)
        if text is None:
            raise MissingDataError(f"${KEY_VARIABLE} is not set. {_HELP}")
        return cls._from_hex(text.encode(errors="replace"), f"The team key in ${KEY_VARIABLE}")

    @classmethod
    def _from_hex(cls, data: bytes, what: str) -> TeamKey:
        """The key of hexadecimal digits. Errors show the length of the data, but no data."""
        digits = data.strip()
        if len(digits) != 2 * KEY_BYTES:
            raise DataError(f"{what} has {len(digits)} characters. {_HELP}")
        try:
            return cls(bytes.fromhex(digits.decode("ascii")))
        except ValueError:
            raise DataError(f"{what} has characters that are no hexadecimal digits. {_HELP}") from None

    def __repr__(self) -> str:
        return "TeamKey(…)"

    def __reduce__(self) -> NoReturn:
        raise InvalidArgumentError("A TeamKey cannot be pickled or copied: give other processes its file.")


WINDOW = 1024
"""Numbers below the highest one of a session for which replays are detected; lower numbers are refused."""
MAX_SESSIONS = 1024
"""Largest number of stored sessions. Beyond it, the sessions that were silent longest are removed."""
RETURNS = 4
"""How often a session must continue after another one of the same robot id, until they are two robots."""
SILENCE = 60.0
"""Seconds for which only one session must send until its robot id counts as unique again."""
FRESH_FRAMES, FRESH_SECONDS = 5, 5.0
"""New frames of one session, and the time from first to last, that show a second robot with this id."""


class ReplayWindow:
    """The numbers of a session that were received: the anti-replay window of IPsec (RFC 4303, appendix
    A2)."""

    __slots__ = ("_seen", "highest")

    def __init__(self) -> None:
        self.highest = -1
        self._seen = 0  # bit i: number highest − i was received

    def accept(self, number: int) -> bool:
        """Whether a number ≥ 0 is new; marks it as received."""
        ahead = number - self.highest
        if ahead > 0:
            kept = self._seen << ahead if ahead < WINDOW else 0
            self._seen = (kept | 1) & ((1 << WINDOW) - 1)
            self.highest = number
            return True
        if -ahead >= WINDOW or self._seen >> -ahead & 1:
            return False
        self._seen |= 1 << -ahead
        return True


@dataclass
class _Speaker:
    """The session of a robot id that sent last, from which address, and since when."""

    session: bytes
    source: str
    since: float
    returns: int = 0


class Sessions:
    """The sessions of other robots. Each start of a robot begins one.

    A robot that restarts begins a new session, and its former session ends. If two sessions of one id send
    alternately, two robots use that id. Both are then refused until only one has sent for `SILENCE` seconds.

    Memory: a few hundred bytes for each of at most `MAX_SESSIONS` sessions.

    Attributes:
        duplicates: robot ids that two robots use now, with the addresses of both.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: seconds that never go back."""
        self._clock = clock
        self._windows: OrderedDict[tuple[int, bytes], ReplayWindow] = OrderedDict()
        self._speakers: dict[int, _Speaker] = {}
        self.duplicates: dict[int, str] = {}

    def refusal(self, sender: int, session: bytes, number: int, source: str = "") -> str | None:
        """Why an authentic datagram is refused: 'replayed', 'duplicate_id', or None if it is accepted.

        source: the sender's address, for messages.
        """
        known = self._windows.get((sender, session))
        window = known or ReplayWindow()
        continues = number > window.highest  # a late datagram of a former session does not
        if not window.accept(number):
            return "replayed"
        self._windows[sender, session] = window
        self._windows.move_to_end((sender, session))
        if len(self._windows) > MAX_SESSIONS:
            self._forget(*self._windows.popitem(last=False)[0])
        if continues:
            self._note_speaker(sender, session, source, returns=known is not None)
        return "duplicate_id" if sender in self.duplicates else None

    def _note_speaker(self, sender: int, session: bytes, source: str, returns: bool) -> None:
        """Update which session of a robot id sends, and whether the id is duplicate."""
        now, speaker = self._clock(), self._speakers.get(sender)
        if speaker is None:
            self._speakers[sender] = _Speaker(session, source, now)
            return
        if session != speaker.session:
            speaker.returns += returns
            if speaker.returns >= RETURNS:
                self.duplicates[sender] = f"{speaker.source} and {source}"
            speaker.session, speaker.source, speaker.since = session, source, now
        elif sender in self.duplicates and now - speaker.since >= SILENCE:
            speaker.returns = 0
            self.duplicates.pop(sender, None)

    def _forget(self, sender: int, session: bytes) -> None:
        speaker = self._speakers.get(sender)
        if speaker is not None and speaker.session == session:
            del self._speakers[sender]
            self.duplicates.pop(sender, None)


@dataclass
class _Continuing:
    """A session that continues: its highest number, and the new frames since its last long silence."""

    since: float
    last: float
    highest: int = -1
    n_fresh: int = 0


class OwnIdWatch:
    """Detects whether another robot uses this robot's id.

    A frame with this robot's id and another session may come from a former start of this robot: late, or
    recorded and replayed. Another robot is reported only after `FRESH_FRAMES` frames of one session, each
    with a higher number than all before, over at least `FRESH_SECONDS`, without a silence of `SILENCE`
    seconds.

    Memory: a few hundred bytes for each of at most `MAX_SESSIONS` sessions.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sessions: OrderedDict[bytes, _Continuing] = OrderedDict()

    def detects(self, session: bytes, number: int) -> bool:
        """Whether another robot uses the id, after an authentic datagram of another session arrived."""
        now = self._clock()
        heard = self._sessions.setdefault(session, _Continuing(now, now))
        self._sessions.move_to_end(session)
        if len(self._sessions) > MAX_SESSIONS:
            self._sessions.popitem(last=False)
        if number <= heard.highest:
            return False
        if now - heard.last > SILENCE:
            heard.since, heard.n_fresh = now, 0
        heard.highest, heard.last, heard.n_fresh = number, now, heard.n_fresh + 1
        return heard.n_fresh >= FRESH_FRAMES and now - heard.since >= FRESH_SECONDS


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


_NONCE = slice(3, None)  # of a header: session and number, 12 bytes; unique for each datagram under one key


def _cipher(key: TeamKey | None) -> tuple[Any, type[Exception]]:
    """ChaCha20-Poly1305 with a team's key, None without one; and the error of data that were altered."""
    if key is None:
        return None, GmmTorchError
    with needs_extra("A team key needs", "cryptography", "network"):
        from cryptography.exceptions import InvalidTag
        from cryptography.hazmat.primitives.ciphers.aead import ChaCha20Poly1305
    return ChaCha20Poly1305(key._data), InvalidTag


class Sealer:
    """Makes frames of one robot's datagrams: sealed with the team's key, or in the clear without one.

    A frame has its sender, a session and a number, which make its nonce. The session is 64 random bits,
    drawn at each start; the number counts from zero. No nonce is used twice: after 2³² datagrams, and in a
    forked process, a new session is drawn. Thread-safe.
    """

    def __init__(self, sender: int, key: TeamKey | None = None) -> None:
        self.sender = check_whole("sender", sender, 0, MAX_SENDER)
        self.overhead = PLAIN_OVERHEAD if key is None else SEALED_OVERHEAD
        self._cipher, _ = _cipher(key)
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
        if self._cipher is not None:
            datagram = self._cipher.encrypt(header[_NONCE], datagram, header)
        return header + datagram

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
        self._cipher, self._altered = _cipher(key)
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
        try:
            datagram = data if self._cipher is None else self._cipher.decrypt(header[_NONCE], data, header)
        except self._altered:
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
