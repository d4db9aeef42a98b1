"""Detects replayed datagrams, and robots with a duplicate id, from sessions and datagram numbers."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

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

    def __len__(self) -> int:
        return len(self._windows)

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

    def __len__(self) -> int:
        return len(self._sessions)

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
