"""Who is speaking: datagrams that come again are refused, and two robots with one number are told apart."""

from __future__ import annotations

import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

WINDOW = 1024
"""How far behind the newest a datagram of a session may come and still be told from a replay."""
MAX_SESSIONS = 1024
"""That are remembered; of more, those longest silent are forgotten."""
RETURNS = 4
"""How often a session must come back after another of the same robot spoke, until they are two robots."""
SILENCE = 60.0
"""Seconds for which one session has to speak alone until it is believed again."""
FRESH_FRAMES, FRESH_SECONDS = 5, 5.0
"""How many new frames of one session, over how long at least, show that a robot is there that sends them."""


class ReplayWindow:
    """Which of a session's last 1024 numbers have been seen: the anti-replay window of IPsec (RFC 4303, A2).

    A number below the window is refused, as nobody remembers whether it has been seen.
    """

    __slots__ = ("_seen", "highest")

    def __init__(self) -> None:
        self.highest = -1
        self._seen = 0  # bit i: highest − i

    def accept(self, number: int) -> bool:
        """Whether a number ≥ 0 is new; from now on it is not."""
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
    """Which session of a robot spoke last, and whence."""

    session: bytes
    source: str
    since: float
    returns: int = 0


class Sessions:
    """The sessions that have been heard, one for each start of each robot.

    A robot that restarts begins a new session, and its former one falls silent. Where sessions speak by
    turns there are two robots with one number, and which of them is meant nobody can know: both are refused,
    until one has spoken alone for a minute.

    Memory: a few hundred bytes for each of at most 1024 sessions.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock`: seconds that never go back, whatever the time of day does."""
        self._clock = clock
        self._windows: OrderedDict[tuple[int, bytes], ReplayWindow] = OrderedDict()
        self._speakers: dict[int, _Speaker] = {}
        self.namesakes: dict[int, str] = {}
        """Numbers that two robots have now, and whence they were heard."""

    def __len__(self) -> int:
        return len(self._windows)

    def refusal(self, sender: int, session: bytes, number: int, source: str = "") -> str | None:
        """Why datagram `number` of a session is not to be believed: 'replayed', 'namesake', or None.

        To be asked only of datagrams that are authentic. `source`: whence it came, for people to read.
        """
        known = self._windows.get((sender, session))
        window = known or ReplayWindow()
        goes_on = number > window.highest  # a straggler of a session that has ended does not
        if not window.accept(number):
            return "replayed"
        self._windows[sender, session] = window
        self._windows.move_to_end((sender, session))
        if len(self._windows) > MAX_SESSIONS:
            self._forget(*self._windows.popitem(last=False)[0])
        if goes_on:
            self._speaks(sender, session, source, returns=known is not None)
        return "namesake" if sender in self.namesakes else None

    def _speaks(self, sender: int, session: bytes, source: str, returns: bool) -> None:
        """A session goes on, or begins: two robots are found, or one of two has fallen silent."""
        now, speaker = self._clock(), self._speakers.get(sender)
        if speaker is None:
            self._speakers[sender] = _Speaker(session, source, now)
            return
        if session != speaker.session:
            speaker.returns += returns
            if speaker.returns >= RETURNS:
                self.namesakes[sender] = f"{speaker.source} and {source}"
            speaker.session, speaker.source, speaker.since = session, source, now
        elif sender in self.namesakes and now - speaker.since >= SILENCE:
            speaker.returns = 0
            self.namesakes.pop(sender, None)

    def _forget(self, sender: int, session: bytes) -> None:
        speaker = self._speakers.get(sender)
        if speaker is not None and speaker.session == session:
            del self._speakers[sender]
            self.namesakes.pop(sender, None)


@dataclass
class _Continuing:
    """A session that goes on: its newest number, and the new ones since it was last silent for long."""

    since: float
    last: float
    highest: int = -1
    n_fresh: int = 0


class TwinWatch:
    """Whether another robot speaks that has this robot's number.

    A frame of that number that is not of this start of the robot may be of a former one: late on a slow way,
    or recorded and played back. So it takes a session that goes on: `FRESH_FRAMES` frames, each newer than
    all before, over `FRESH_SECONDS` or longer, without a silence of a minute.

    Memory: a few hundred bytes for each of at most 1024 sessions.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._sessions: OrderedDict[bytes, _Continuing] = OrderedDict()

    def __len__(self) -> int:
        return len(self._sessions)

    def finds(self, session: bytes, number: int) -> bool:
        """Whether there is another, now that datagram `number` of a session of its has come.

        To be asked only of datagrams that are authentic, and not of this start of the robot.
        """
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
