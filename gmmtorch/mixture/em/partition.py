"""Cutting a cloud into flat pieces: how many components it needs, and where they begin.

A piece is halved at its mean, across its longest direction, as long as it is thicker than the
sensor's noise explains or longer than a component should be, and both halves keep enough points.
The pieces of one level are cut in one batch of tensor operations. What a surface looks like thus
decides the number of components: a wall takes few, clutter many, and never more than its points
can support. Where their number is given, the pieces that are worth most are cut first: large,
long, and above all thick ones.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.linalg import unpack_symmetric
from gmmtorch.mixture.em.exact import quadratic_features

_MAX_LEVELS = 64
_WORTH_OF_THICKNESS = 30.0
"""A piece's variance across counts so many times its variance along. It is the thick pieces, those
that span several surfaces, that put matter where there is none (BENCHMARKS.md, "Where EM starts")."""


@dataclass(frozen=True)
class FlatnessRule:
    """When a piece is cut: standard deviations in metres, weights in points.

    thickness: pieces whose thinnest direction exceeds it are not flat. length: pieces whose
    longest direction exceeds it are too long. min_weight: no half may weigh less;
    min_weight_thick: nor the halves of a piece of over twice the thickness, which spans several
    surfaces. max_components: pieces at most; half of them are cut at a time, those worth most first.
    apart: halves may weigh anything if they lie further apart than this (m), as stray returns do.
    """

    thickness: float = 0.02
    length: float = 0.3
    min_weight: float = 3.0
    min_weight_thick: float = 1.0
    max_components: int | None = None
    apart: float = 3.0


class Partition(NamedTuple):
    """labels (N,): the piece of each point; n_pieces: how many there are, none of them empty."""

    labels: Tensor
    n_pieces: int


def pool(features: Tensor, weight: Tensor, labels: Tensor, n_pieces: int) -> Tensor:
    """Weighted sums (n_pieces, F) of features (N, F) by label: the statistics of each piece."""
    sums = features.new_zeros(n_pieces, features.shape[1])
    return sums.index_add_(0, labels, features * weight[:, None])


def partition(
    points: Tensor, weight: Tensor, rule: FlatnessRule, features: Tensor | None = None
) -> Partition:
    """Cut points (N, D), centred, float64, N ≥ 1, with weights (N,) into flat pieces.

    Where the points are the means of cells, `features` (N, F), the cells' mean features, tell how
    thick the pieces are within the cells, too.
    """
    n, dim = points.shape
    features = quadratic_features(points) if features is None else features
    labels = torch.zeros(n, dtype=torch.int64, device=points.device)
    n_pieces = 1
    for _ in range(_MAX_LEVELS):
        statistics = pool(features, weight, labels, n_pieces)
        count = statistics[:, 0].clamp_min(1e-300)
        means = statistics[:, 1 : 1 + dim] / count[:, None]
        second = unpack_symmetric(statistics[:, 1 + dim :] / count[:, None], dim)
        variances, directions = torch.linalg.eigh(second - means[:, :, None] * means[:, None, :])
        deviation = variances.clamp_min(0).sqrt()
        wanted = (deviation[:, 0] > rule.thickness) | (deviation[:, -1] > rule.length)
        thick = (deviation[:, 0] > 2 * rule.thickness).to(count)
        least = rule.min_weight + thick * (rule.min_weight_thick - rule.min_weight)
        along = torch.linalg.vecdot(
            points - means.index_select(0, labels), directions[:, :, -1].index_select(0, labels)
        )
        beyond = along > 0
        supported = _is_supported(along, labels, weight, n_pieces, least, rule.apart)
        cut = wanted & supported & (count >= 2 * least) & (deviation[:, -1] > 0)
        cut = _within_budget(cut, _worth(count, variances), n_pieces, rule.max_components)
        n_new = int(cut.sum())
        if n_new == 0:
            break
        new_label = torch.cumsum(cut.long(), 0) - 1 + n_pieces
        labels = torch.where(cut[labels] & beyond, new_label[labels], labels)
        n_pieces += n_new
    return Partition(labels, n_pieces)


def _worth(count: Tensor, variances: Tensor) -> Tensor:
    """What cutting pieces of these weights (n,) and variances (n, D), ascending, is worth."""
    return count * (variances[:, -1] + _WORTH_OF_THICKNESS * variances[:, 0].clamp_min(0))


def _within_budget(cut: Tensor, worth: Tensor, n_pieces: int, limit: int | None) -> Tensor:
    """Of the pieces to be cut, those worth most: half of all, once they are many; within the `limit`."""
    if limit is None:
        return cut
    order = torch.where(cut, worth, -torch.inf).argsort(descending=True)
    chosen = torch.zeros_like(cut)
    # All of a few pieces will be cut anyway.
    at_once = n_pieces if 4 * n_pieces <= limit else (n_pieces + 1) // 2
    chosen[order[: max(0, min(limit - n_pieces, at_once))]] = True
    return chosen & cut


def _is_supported(
    along: Tensor, labels: Tensor, weight: Tensor, n_pieces: int, least: Tensor, far: float
) -> Tensor:
    """Whether a cut at 0 of positions (N,) along each piece's axis is worth it, (n_pieces,).

    Both sides must weigh `least` (n_pieces,). A smaller side is cut off all the same if it lies apart:
    further than `far` (m) and than six deviations of the larger side. Else a few stray returns would
    keep the cloud that they belong to whole.
    """
    side = labels * 2 + (along > 0)
    if not bool(least.any()):
        return torch.bincount(side, minlength=2 * n_pieces).view(n_pieces, 2).amin(1) > 0
    moments = torch.stack([torch.ones_like(along), along, along**2], 1) * weight[:, None]
    sums = moments.new_zeros(2 * n_pieces, 3).index_add_(0, side, moments).view(n_pieces, 2, 3)
    count = sums[..., 0]
    mean, square = (sums[..., i] / count.clamp_min(1e-300) for i in (1, 2))
    deviation = (square - mean**2).clamp_min(0).sqrt().gather(1, count.argmax(1, keepdim=True)).squeeze(1)
    gap = mean[:, 1] - mean[:, 0]
    apart = (gap > far) & (gap > 6 * deviation)
    return (count.amin(1) > 0) & ((count.amin(1) >= least) | apart)
