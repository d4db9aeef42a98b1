"""The replicated map of a team, its store on disk, and the networks that carry its messages.

Names are imported when they are first used, so that `import gmmtorch.team.sharing` stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.team.sharing.frame_joiner import FrameJoiner as FrameJoiner
    from gmmtorch.team.sharing.replica.moved_map import MovedMap as MovedMap
    from gmmtorch.team.sharing.replica.replica import Replica as Replica
    from gmmtorch.team.sharing.store import Store as Store

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "FrameJoiner": "frame_joiner",
        "MovedMap": "replica.moved_map",
        "Replica": "replica.replica",
        "Store": "store",
    },
)
