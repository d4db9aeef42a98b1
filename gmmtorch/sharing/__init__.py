"""The replicated map of a team, its store on disk, and the networks that carry its messages.

`Replica` and `Store` are imported when they are first used, so that `import gmmtorch.sharing` stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gmmtorch.sharing.replica.replica import Replica as Replica
    from gmmtorch.sharing.store import Store as Store

__all__ = ["Replica", "Store"]

_HOMES = {
    "Replica": "gmmtorch.sharing.replica.replica",
    "Store": "gmmtorch.sharing.store",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(importlib.import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'gmmtorch.sharing' has no attribute {name!r}")
