"""What is refused of what others say, and how it is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from gmmtorch.errors import GmmTorchError
from gmmtorch.sharing.replica.records import RefusedError as RefusedError


def merged(take: Callable[[], None], refused: Counter[str], conflicts: Counter[int]) -> bool:
    """Whether what came was taken in; what refuses it is counted, by reason and, of conflicts, by robot."""
    try:
        take()
    except RefusedError as refusal:
        refused[refusal.reason] += 1
        if refusal.reason in ("conflict", "duplicate_id"):
            conflicts[refusal.robot] += 1
        return False
    except GmmTorchError:
        refused["damaged"] += 1
        return False
    return True
