"""Results of the twin and of the fused kernel."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from gmmtorch.kernels import kernels

T = TypeVar("T")


def by_both(compute: Callable[[], T]) -> tuple[T, T]:
    """The result of a function with the twin, and with the fused kernel."""
    with kernels("torch"):
        twin = compute()
    with kernels("fused"):
        return twin, compute()
