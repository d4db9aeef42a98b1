"""A tree of Gaussians, each node the part of the cloud that its children share."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError


class Tree(NamedTuple):
    """Nodes, level by level, parents before children; the root, which is the whole cloud, is not among them.

    parents (M,): the parent of each node, −1 on the first level; weights (M,) of nodes in the cloud,
    means (M, D), covariances (M, D, D). The children of a node weigh together what it weighs.
    """

    parents: Tensor
    weights: Tensor
    means: Tensor
    covariances: Tensor

    def leaves(self) -> Tensor:
        """The nodes (K,) without children, in order."""
        is_leaf = torch.ones_like(self.parents, dtype=torch.bool)
        is_leaf[self.parents[self.parents >= 0]] = False
        return is_leaf.nonzero().squeeze(1)

    def levels(self) -> Tensor:
        """Level (M,) of each node, from 1."""
        level, above = torch.ones_like(self.parents), self.parents.clone()
        while bool((above >= 0).any()):
            inner = above >= 0
            level[inner] += 1
            above[inner] = self.parents[above[inner]]
        return level

    def at_level(self, level: int) -> Tensor:
        """The nodes of a level, and the leaves that ended above it: together, the whole cloud."""
        levels = self.levels()
        is_leaf = torch.zeros_like(levels, dtype=torch.bool)
        is_leaf[self.leaves()] = True
        return ((levels == level) | (is_leaf & (levels < level))).nonzero().squeeze(1)


def check_tree(tree: Tree, leaf_weights: Tensor) -> None:
    """Raise `InvalidArgumentError` unless it is a tree, and its leaves have these weights (K,)."""
    parents, *values = tree
    n, dim = parents.numel(), tree.means.shape[-1] if tree.means.ndim else 0
    if parents.shape != (n,) or parents.dtype != torch.int64:
        raise InvalidArgumentError(
            f"parents is {parents.dtype} {tuple(parents.shape)}; expected (M,) whole numbers, int64."
        )
    for name, value, shape in zip(tree._fields[1:], values, ((n,), (n, dim), (n, dim, dim)), strict=True):
        if tuple(value.shape) != shape or value.dtype != torch.float64:
            raise InvalidArgumentError(
                f"{name} is {value.dtype} {tuple(value.shape)}; expected float64 {shape}."
            )
    if bool(((parents < -1) | (parents >= torch.arange(n, device=parents.device))).any()):
        raise InvalidArgumentError(f"parents={parents.tolist()} must be −1, or nodes before their children.")
    leaves = tree.leaves()
    if leaves.shape != leaf_weights.shape or not torch.allclose(tree.weights[leaves], leaf_weights):
        raise InvalidArgumentError(
            f"The tree's {leaves.numel()} leaves are not the mixture's {len(leaf_weights)}."
        )
