"""The sessions that a robot has begun before, on its disk: what it said in them is no other robot's."""

from __future__ import annotations

import os
from pathlib import Path

from gmmtorch.errors import DataError
from gmmtorch.sharing.journal_files import read, write_durably
from gmmtorch.sharing.transport.security import SESSION_BYTES

MOST_SESSIONS = 1024
"""That are kept: of more, the oldest are forgotten."""
_MAGIC = b"GMMTSES1"
_MOST_BYTES = len(_MAGIC) + MOST_SESSIONS * SESSION_BYTES


def former_sessions(path: str | Path, session: bytes) -> frozenset[bytes]:
    """Those kept at `path`, but for `session`, which is kept with them from now on.

    To be called before anything is sent in `session`: see `FramedTransport.session`. See docs/network.md.

    Raises `DataError` for a file that is none of these, and `OutputError` where it cannot be written: those
    that were kept before are `known_sessions`.
    """
    path = Path(path)
    former = [one for one in _read(path) if one != session]
    write_durably(path, b"".join([_MAGIC, *former[1 - MOST_SESSIONS :], session]))
    return frozenset(former)


def known_sessions(path: str | Path) -> frozenset[bytes]:
    """Those kept at `path`, and nothing more. Raises `DataError` for a file that is none of these."""
    return frozenset(_read(Path(path)))


def _read(path: Path) -> list[bytes]:
    """Oldest first; none where there is no file."""
    if not os.path.exists(path):  # unlike a Path's own, no error where nobody may look
        return []
    data = read(path, _MOST_BYTES)
    if data is None or not data.startswith(_MAGIC) or (len(data) - len(_MAGIC)) % SESSION_BYTES:
        raise DataError(
            f"{path} is damaged, or holds no sessions of a robot. Remove it: what the robot said before may "
            "then be played back to it as another robot's."
        )
    return [data[at : at + SESSION_BYTES] for at in range(len(_MAGIC), len(data), SESSION_BYTES)]
