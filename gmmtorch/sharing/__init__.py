"""What robots tell one another, as bytes, and the networks that carry it.

`Replica` is imported when it is first used, so that `import gmmtorch.sharing` stays light.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gmmtorch.sharing.replica import Replica as Replica

__all__ = ["Replica"]


def __getattr__(name: str) -> Any:
    if name == "Replica":
        return importlib.import_module("gmmtorch.sharing.replica").Replica
    raise AttributeError(f"module 'gmmtorch.sharing' has no attribute {name!r}")
