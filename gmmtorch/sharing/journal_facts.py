"""The facts of a journal: of which world or log the map is that a robot keeps on its disk."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.sharing.journal_files import read, write_durably

_KIND, _VERSION = "gmmtorch.journal_facts", 1
_MOST_BYTES = 1 << 16
_MOST_SHOWN = 40
"""Characters of a value, in a message."""


def check_facts(path: str | Path, facts: Mapping[str, Any]) -> None:
    """Raises `InvalidArgumentError` where what is kept at `path` differs from `facts`, plain values by name;
    and `DataError` for a file that holds none. Nothing is wrong where there is no file."""
    kept = _read(Path(path))
    mine = _plain(facts)
    different = sorted(name for name in {*mine, *kept} if mine.get(name) != kept.get(name)) if kept else []
    if different:
        told = ", ".join(
            f"{_shown(name)} was {_shown(kept.get(name))} and is {_shown(mine.get(name))}"
            for name in different
        )
        raise InvalidArgumentError(
            f"path={str(path)!r} is of another world or log: {told}. Give another folder, or the "
            "options that it was begun with."
        )


def keep_facts(path: str | Path, facts: Mapping[str, Any]) -> None:
    """Keep `facts` at `path`, if nothing is kept there. Raises `OutputError` where it cannot be written."""
    if not os.path.exists(path):
        about = {"format": _KIND, "version": _VERSION, "facts": _plain(facts)}
        write_durably(Path(path), (json.dumps(about, indent=2, sort_keys=True) + "\n").encode())


def _plain(facts: Mapping[str, Any]) -> dict[str, Any]:
    """As they come back from a file."""
    plain: dict[str, Any] = json.loads(json.dumps(dict(facts)))
    return plain


def _read(path: Path) -> dict[str, Any]:
    """The facts kept at `path`; none where there is no file."""
    if not os.path.exists(path):
        return {}
    try:
        about = json.loads(read(path, _MOST_BYTES) or b"")
        known = isinstance(about, dict) and (about.get("format"), about.get("version")) == (_KIND, _VERSION)
        facts = about["facts"] if known else None
    except (ValueError, RecursionError, LookupError):
        facts = None
    if not isinstance(facts, dict) or not facts:
        raise DataError(
            f"{path} is damaged, or of another version of gmmtorch. Remove it, if the map beside it is of "
            "the world or log that the robot is in now; else give another folder."
        )
    return facts


def _shown(value: Any) -> str:
    """As a short piece of a line, whatever it holds."""
    text = value if isinstance(value, str) and value.isprintable() else json.dumps(value)
    return text if len(text) <= _MOST_SHOWN else text[:_MOST_SHOWN] + "…"
