"""Results of the twin and of the fused kernel, and the memory that they take."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from gmmtorch.kernels import kernels

T = TypeVar("T")


def by_both(compute: Callable[[], T]) -> tuple[T, T]:
    """The result of a function with the twin, and with the fused kernel."""
    with kernels("torch"):
        twin = compute()
    with kernels("fused"):
        return twin, compute()


class Largest(TorchDispatchMode):
    """The entries of the largest tensor that an operation makes."""

    entries = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        result = func(*args, **(kwargs or {}))
        for leaf in tree_leaves(result):
            if isinstance(leaf, Tensor) and not leaf._is_view():
                self.entries = max(self.entries, leaf.numel())
        return result
