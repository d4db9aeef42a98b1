"""What is refused of what others say, and how it is counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from gmmtorch.errors import DataError, GmmTorchError


class RefusedError(DataError):
    """What came is sound, and not taken in; `reason` is one of few, `robot` whose it is."""

    def __init__(self, reason: str, robot: int, message: str) -> None:
        super().__init__(message)
        self.reason, self.robot = reason, robot


def merged(take: Callable[[], None], refused: Counter[str], conflicts: Counter[int]) -> bool:
    """Whether what came was taken in; what refuses it is counted, by reason and, of conflicts, by robot."""
    try:
        take()
    except RefusedError as refusal:
        refused[refusal.reason] += 1
        if refusal.reason == "conflict":
            conflicts[refusal.robot] += 1
        return False
    except GmmTorchError:
        refused["damaged"] += 1
        return False
    return True
