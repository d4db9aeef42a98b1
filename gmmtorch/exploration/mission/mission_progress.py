"""Progress: how far a robot is in its log, and its own map then, on its disk."""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import re
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError
from gmmtorch.files import joined_tensors, pack_tensors, split_tensors, unpack_tensors
from gmmtorch.sharing.journal_files import read, write_durably

_KIND, _VERSION = "progress", 1
_DIGEST_BYTES = 16
_MOST_BYTES = 1 << 30
_log = logging.getLogger(__name__)


class Progress:
    """States of a robot's map, each after so many scans, as files `map-<scans>`: BLAKE2b of the rest (16
    bytes), and a safetensors file. They are whole or not there, also after a loss of power; the newest two
    stay, should one rot.

    Args:
        folder: of this robot alone; made if need be.
        facts: plain values that say what the states are of. Those of others are refused.
    """

    def __init__(self, folder: str | Path, **facts: Any) -> None:
        self.folder = Path(folder)
        self._facts = json.loads(json.dumps(facts))
        self._last: int | None = None  # that is sound, for all that is known

    @property
    def farthest(self) -> int | None:
        """After how many scans the last state was saved, be it readable or not; None: none was."""
        return max(self._numbers(), default=None)

    def save(self, n_scans: int, state: dict[str, Any]) -> None:
        """Write the state after so many scans. Raises `OutputError`; what was saved stays then."""
        tree, tensors = split_tensors(state)
        data = pack_tensors(tensors, _KIND, _VERSION, tree=tree, facts=self._facts)
        write_durably(self._place(n_scans), _digest(data) + data)
        # One that is damaged stays until there is a newer one: it tells how far the robot was.
        old = [number for number in self._numbers() if number < n_scans and number != self._last]
        self._last = n_scans
        for number in old:
            with contextlib.suppress(OSError):
                self._place(number).unlink()
        for fragment in self.folder.glob(".map-*.state"):
            with contextlib.suppress(OSError):
                fragment.unlink()

    def newest(self) -> tuple[int, dict[str, Any]] | None:
        """The newest state that is sound, and after how many scans it was; None: there is none.

        Raises `DataError` for a state of something else.
        """
        for number in reversed(self._numbers()):
            path = self._place(number)
            data = read(path, _MOST_BYTES)
            if data is None or data[:_DIGEST_BYTES] != _digest(data[_DIGEST_BYTES:]):
                _log.warning("%s is damaged; what is older is used.", path)
                continue
            tensors, about = unpack_tensors(data[_DIGEST_BYTES:], path, _KIND, _VERSION)
            self._check(path, about.get("facts"))
            try:
                state: dict[str, Any] = joined_tensors(about["tree"], tensors)
            except (KeyError, TypeError, AttributeError) as error:
                raise DataError(f"{path} is no state of a map ({error!r}).") from error
            self._last = number
            return number, state
        return None

    def _check(self, path: Path, kept: Any) -> None:
        kept = kept if isinstance(kept, dict) else {}
        different = sorted(key for key in {*self._facts, *kept} if self._facts.get(key) != kept.get(key))
        if different:
            raise DataError(
                f"{path} is of another run ({', '.join(different)} differ); give the options it was started "
                "with, or another folder."
            )

    def _place(self, number: int) -> Path:
        return self.folder / f"map-{number:08d}.state"

    def _numbers(self) -> list[int]:
        """Of the files that are there, rising."""
        matches = (
            re.fullmatch(r"map-(\d{8,18})\.state", path.name) for path in self.folder.glob("map-*.state")
        )
        return sorted(int(match[1]) for match in matches if match)


def _digest(data: bytes) -> bytes:
    return hashlib.blake2b(data, digest_size=_DIGEST_BYTES).digest()
