"""Attributes of components: moments of channels such as colour, jointly with the position, and label shares.

A component whose points p have values a is one Gaussian of (p, a). It is stored as the regression of a on p:

    a | p ~ N(m + G (p − μ), R),  G = C_ap Σ⁻¹,  R = C_aa − G C_ap ᵀ,

so a painted wall has a gradient, and merging preserves the moments of (p, a). A component counts how many of
its points have each label. Both are relative to the support of the component.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import value_sums
from gmmtorch.linalg import pack_symmetric, triangle_indices, unpack_symmetric
from gmmtorch.mixture import Cells
from gmmtorch.scan import LARGEST_LABEL

_SLOPE_PRIOR = 3.0  # points, spread like the component, that show no slope
_NOISE_PRIOR = 1.0  # points that deviate like those of all components


class Numbers(NamedTuple):
    """A channel of A numbers in K components: share (K,) of the points that have a value, mean (K, A) at the
    component's mean, slope (K, A, D) per metre, covariance (K, A, A) of what the slope does not explain."""

    share: Tensor
    mean: Tensor
    slope: Tensor
    covariance: Tensor


class Labels(NamedTuple):
    """A channel of classes: share (K, C) of each component's points that have each of the labels (C,), which
    increase."""

    share: Tensor
    labels: Tensor


Channel = Numbers | Labels
_LABELS = "labels"


@dataclass(frozen=True, eq=False)
class Attributes:
    """The channels of K components by name; none for components without attributes."""

    channels: Mapping[str, Channel] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self.channels)

    def tensors(self) -> dict[str, Tensor]:
        """All tensors, named "channel.field"."""
        return {
            f"{name}.{part}": value
            for name, channel in self.channels.items()
            for part, value in channel._asdict().items()
        }

    @classmethod
    def of(cls, tensors: Mapping[str, Tensor]) -> Attributes:
        """The attributes of `tensors`. Raises `InvalidArgumentError` if some are missing or foreign."""
        parts: dict[str, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            name, _, part = key.rpartition(".")
            parts.setdefault(name, {})[part] = value
        kinds = {frozenset(kind._fields): kind for kind in (Numbers, Labels)}
        if any(frozenset(found) not in kinds for found in parts.values()):
            raise InvalidArgumentError(f"attributes are {', '.join(tensors)}: not those of a channel.")
        made = cls({name: kinds[frozenset(found)](**found) for name, found in parts.items()})
        return made._of_rows(lambda value: value.double())

    def changed(self, change: Callable[[Tensor], Tensor]) -> Attributes:
        """The attributes with `change` applied to each tensor."""
        return Attributes({name: type(c)(*map(change, c)) for name, c in self.channels.items()})

    def on_cpu(self) -> Attributes:
        """The attributes on the CPU, without gradients."""
        return self.changed(lambda value: value.detach().cpu())

    def selected(self, rows: Tensor | slice) -> Attributes:
        """Those of some components (J,), in that order."""
        return self._of_rows(lambda value: value[rows])

    def only(self, names: Container[str]) -> Attributes:
        """The channels with these names."""
        return Attributes({name: c for name, c in self.channels.items() if name in names})

    def present(self) -> Attributes:
        """The channels and labels that a component has."""
        found: dict[str, Channel] = {}
        for name, c in self.channels.items():
            if isinstance(c, Labels):
                used = (c.share > 0).any(0)
                c = Labels(c.share[:, used], c.labels[used])
            if bool((c.share > 0).any()):
                found[name] = c
        return Attributes(found)

    def _of_rows(self, change: Callable[[Tensor], Tensor]) -> Attributes:
        """The attributes with `change` applied to each tensor that has a row for each component."""
        return Attributes(
            {
                name: type(c)(*(v if part == _LABELS else change(v) for part, v in c._asdict().items()))
                for name, c in self.channels.items()
            }
        )

    @classmethod
    def concatenate(cls, parts: Sequence[Attributes], sizes: Sequence[int]) -> Attributes:
        """The attributes of parts with these numbers of components. A part without a channel has share 0."""
        names = dict.fromkeys(name for part in parts for name in part.channels)
        check_kinds(part.channels for part in parts)
        return cls({name: _joined([part.channels.get(name) for part in parts], sizes) for name in names})

    def turned(self, rotation: Tensor) -> Attributes:
        """The attributes of components turned by a rotation (D, D), or by one each (K, D, D)."""
        return self.with_numbers(lambda c: c._replace(slope=c.slope @ rotation.mT))

    def with_numbers(self, change: Callable[[Numbers], Numbers]) -> Attributes:
        """The attributes with `change` applied to each channel of numbers."""
        return Attributes(
            {name: change(c) if isinstance(c, Numbers) else c for name, c in self.channels.items()}
        )

    def replaced(self, rows: Tensor, other: Attributes) -> Attributes:
        """These attributes with those of other components in some rows (J,)."""
        found: dict[str, Channel] = {}
        for name, c in self.channels.items():
            both = zip(c._fields, c, other.channels[name], strict=True)
            found[name] = type(c)(
                *(a if part == _LABELS else a.index_copy(0, rows, b) for part, a, b in both)
            )
        return Attributes(found)

    def checked(self, k: int, dim: int) -> Attributes:
        """These attributes, if their shapes and values are those of K components in D dimensions; otherwise
        raises `InvalidArgumentError`."""
        for name, c in self.channels.items():
            width = c.covariance.shape[-1:].numel() if isinstance(c, Numbers) else c.labels.numel()
            expected = (
                {"share": (k,), "mean": (k, width), "slope": (k, width, dim), "covariance": (k, width, width)}
                if isinstance(c, Numbers)
                else {"share": (k, width), "labels": (width,)}
            )
            for part, value in c._asdict().items():
                if tuple(value.shape) != expected[part] or not bool(torch.isfinite(value).all()):
                    raise InvalidArgumentError(
                        f"attributes {name}.{part} have shape {tuple(value.shape)} or NaN; expected finite "
                        f"{expected[part]}."
                    )
            total = c.share.sum(1) if isinstance(c, Labels) else c.share
            if bool((c.share < 0).any()) or bool((total > 1 + 1e-6).any()):
                raise InvalidArgumentError(f"attributes {name}.share is not from 0 to 1.")
            if isinstance(c, Numbers) and bool((c.covariance.diagonal(dim1=1, dim2=2) < 0).any()):
                raise InvalidArgumentError(f"attributes {name}.covariance has negative variances.")
            if isinstance(c, Labels) and (
                c.labels.is_floating_point()
                or bool((c.labels.diff() <= 0).any())
                or bool(((c.labels < 0) | (c.labels > LARGEST_LABEL)).any())
            ):
                raise InvalidArgumentError(
                    f"attributes {name}.labels are not rising whole numbers from 0 to {LARGEST_LABEL}."
                )
        return self


def check_kinds(parts: Iterable[Mapping[str, Channel | Tensor]]) -> None:
    """Raises `InvalidArgumentError` if a channel of scans or components is numbers in one part and labels in
    another, or has different numbers of columns."""
    kinds: dict[str, int] = {}
    for name, c in ((name, c) for part in parts for name, c in part.items()):
        values = c.mean if isinstance(c, Numbers) else c.labels if isinstance(c, Labels) else c
        kind = values.shape[1] if values.is_floating_point() else 0
        if kinds.setdefault(name, kind) != kind:
            raise InvalidArgumentError(
                f"attributes {name!r} are numbers in some scans and labels in others, or have different "
                "numbers of columns; give one kind."
            )


def _joined(given: Sequence[Channel | None], sizes: Sequence[int]) -> Channel:
    """One channel of several parts; None: of a part that does not have it."""
    first = next(c for c in given if c is not None)
    if isinstance(first, Labels):
        labels = torch.unique(torch.cat([c.labels for c in given if isinstance(c, Labels)]))
        shares = []
        for c, n in zip(given, sizes, strict=True):
            share = first.share.new_zeros(n, len(labels))
            if isinstance(c, Labels):
                share[:, torch.searchsorted(labels, c.labels)] = c.share
            shares.append(share)
        return Labels(torch.cat(shares), labels)
    parts = [
        c if c is not None else Numbers(*(v.new_zeros(n, *v.shape[1:]) for v in first))
        for c, n in zip(given, sizes, strict=True)
    ]
    return Numbers(*(torch.cat(values) for values in zip(*parts, strict=True)))


def of_scans(scans: Sequence[Mapping[str, Tensor]], sizes: Sequence[int]) -> dict[str, Tensor]:
    """The channels (N, …) of the points of several scans together, unknown where a scan lacks one.

    Raises `InvalidArgumentError` if a channel has different kinds or columns in the scans.
    """
    check_kinds(scans)
    found = {}
    for name in dict.fromkeys(name for scan in scans for name in scan):
        first = next(scan[name] for scan in scans if name in scan)
        unknown = torch.nan if first.is_floating_point() else -1
        parts = [
            scan[name] if name in scan else first.new_full((n, *first.shape[1:]), unknown)
            for scan, n in zip(scans, sizes, strict=True)
        ]
        found[name] = torch.cat(parts)
    return found


def learned(
    channels: Mapping[str, Tensor], cells: Cells, owner: Tensor, means: Tensor, covariances: Tensor
) -> Attributes:
    """The attributes of K components, from the channels of points that are summed into C cells.

    owner (C,): the component of each cell, −1 for those without one. means, covariances: of the components,
    in the frame of the cells.
    """
    kept = (owner >= 0).nonzero().squeeze(1)
    owner = owner[kept]
    total = _sums(owner, len(means), cells.weight[kept])
    found: dict[str, Channel] = {}
    for name, values in channels.items():
        if values.is_floating_point():
            sums, middle = _cell_sums(values, cells)
            places = cells.features.index_select(0, kept)
            sums = sums.index_select(0, kept)
            own = _regression(sums, values.shape[1], places, owner, means, covariances, total)
            found[name] = own._replace(mean=own.mean + middle * (own.share > 0)[:, None])
        else:
            found[name] = _label_shares(values, cells, kept, owner, total)
    return Attributes(found)


def _sums(group: Tensor, n: int, values: Tensor) -> Tensor:
    """The sum (n,) of the values (N,) of each group; for a few columns much faster than `index_add`."""
    return torch.bincount(group, values, minlength=n).to(values.dtype)  # of no values it is int64


def _cell_sums(values: Tensor, cells: Cells) -> tuple[Tensor, Tensor]:
    """Of the values (N, A), NaN where unknown, in each of C cells: their number, sums, and sums of products,
    (C, 1 + A + A(A+1)/2), less one of the values (A,), which is returned: squares far from zero have no
    digits left for a variance."""
    member, n = cells.member, len(cells.weight)
    middle = values.new_zeros(values.shape[1], dtype=torch.float64)
    known = torch.isfinite(values.double() @ (middle + 1))  # a sum of rows takes twice as long
    if len(values):
        middle = values[known.byte().argmax()].double().nan_to_num()
    sums = value_sums(values, member, n, middle)
    if sums is not None:
        return sums, middle
    columns = [torch.where(known, column, 0.0) for column in (values - middle).T.contiguous()]
    rows, others = triangle_indices(len(columns))
    products = [columns[i] * columns[j] for i, j in zip(rows.tolist(), others.tolist(), strict=True)]
    summed = [_sums(member, n, column) for column in [known.double(), *columns, *products]]
    return torch.stack(summed, 1), middle


def _label_shares(values: Tensor, cells: Cells, kept: Tensor, owner: Tensor, total: Tensor) -> Labels:
    known = values >= 0
    labels, code = torch.unique(values[known], return_inverse=True)
    place = torch.full_like(cells.weight, -1, dtype=torch.int64).index_copy(0, kept, owner)
    group = place[cells.member[known]]
    group, code = group[group >= 0], code[group >= 0]
    counts = torch.bincount(group * len(labels) + code, minlength=len(total) * len(labels))
    return Labels(counts.view(len(total), len(labels)) / total.clamp_min(1)[:, None], labels)


def _regression(
    sums: Tensor, width: int, places: Tensor, owner: Tensor, means: Tensor, covariances: Tensor, total: Tensor
) -> Numbers:
    """The regression of values on the positions of the points of each component.

    Values vary within a cell as if its points were at its mean. A few points do not show a slope: the prior
    adds points without one. The deviations of a component with few points are close to those of all.

    Args:
        sums: (C, …) of the cells, as in `_cell_sums`. places: (C, F) their mean features.
        owner, means, covariances: as in `learned`. total: (K,) points of the components.
    """
    k, dim = means.shape
    count, value, product = sums.split([1, width, sums.shape[1] - 1 - width], 1)
    middle = value.sum(0) / count.sum().clamp_min(1)
    at = places[:, 1 : 1 + dim]
    within = unpack_symmetric(places[:, 1 + dim :], dim) - at[:, :, None] * at[:, None]
    offset = at - means[owner]
    away = value - count * middle
    cross = away[:, :, None] * offset[:, None]
    spread = count[:, :, None] * (within + offset[:, :, None] * offset[:, None])
    features = [count, count * offset, away, pack_symmetric(spread), cross.flatten(1), product]
    joined = torch.cat(features, 1)
    whole = joined.new_zeros(k, joined.shape[1]).index_add_(0, owner, joined)
    n = whole[:, 0]
    parts = (whole / n.clamp_min(1)[:, None]).split([f.shape[1] for f in features], 1)
    _, at, mean, *packed = parts
    spread = unpack_symmetric(packed[0], dim) - at[:, :, None] * at[:, None]
    cross = packed[1].view(k, width, dim) - mean[:, :, None] * at[:, None]
    true_mean = mean + middle
    own = unpack_symmetric(packed[2], width) - true_mean[:, :, None] * true_mean[:, None]
    prior = covariances * (_SLOPE_PRIOR / n.clamp_min(1))[:, None, None]
    slope = torch.linalg.solve(spread + prior, cross.mT).mT
    explained = slope @ cross.mT
    left = own - explained - explained.mT + slope @ spread @ slope.mT
    usual = (n[:, None, None] * left).sum(0) / n.sum().clamp_min(1)
    weight = (n / (n + _NOISE_PRIOR))[:, None, None]
    has = (n > 0).double()
    noise = _definite(weight * left + (1 - weight) * usual)
    return Numbers(
        n / total.clamp_min(1),
        (true_mean - (slope @ at[:, :, None])[:, :, 0]) * has[:, None],
        slope * has[:, None, None],
        noise * has[:, None, None],
    )


def _definite(matrices: Tensor) -> Tensor:
    """Symmetric matrices (K, A, A) without negative eigenvalues, which rounding can cause."""
    values, axes = torch.linalg.eigh((matrices + matrices.mT) / 2)
    return (axes * values.clamp_min(0)[:, None]) @ axes.mT


def merged(
    attributes: Attributes,
    labels: Tensor,
    weights: Tensor,
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
) -> Attributes:
    """The attributes of components that are merged by label (K,), whose joint moments are preserved.

    weights (K,): supports. before, after: means and covariances, before and after the merge.
    """
    n = len(after[0])

    def summed(values: Tensor) -> Tensor:
        return values.new_zeros(n, *values.shape[1:]).index_add_(0, labels, values)

    total = summed(weights)
    found: dict[str, Channel] = {}
    for name, c in attributes.channels.items():
        if isinstance(c, Labels):
            found[name] = c._replace(share=_ratio(summed(weights[:, None] * c.share), total))
            continue
        width, dim = c.mean.shape[1], before[0].shape[1]
        weight = weights * c.share
        known = summed(weight)
        means, joint = _joint(c, *before)
        center = _ratio(summed(weight[:, None] * means), known)
        away = means - center[labels]
        joint = joint + away[:, :, None] * away[:, None]
        joint = _ratio(summed(weight[:, None, None] * joint), known)
        spread = torch.where((known > 0)[:, None, None], joint[:, :dim, :dim], after[1])
        slope = torch.linalg.solve(spread, joint[:, :dim, dim:]).mT
        left = joint[:, dim:, dim:] - slope @ joint[:, :dim, dim:]
        shift = (slope @ (after[0] - center[:, :dim])[:, :, None])[:, :, 0]
        has = (known > 0).to(shift)
        mean = (center[:, dim : dim + width] + shift) * has[:, None]
        found[name] = Numbers(_ratio(known, total), mean, slope * has[:, None, None], _definite(left))
    return Attributes(found)


def _joint(c: Numbers, means: Tensor, covariances: Tensor) -> tuple[Tensor, Tensor]:
    """Means (K, D+A) and covariances of position and attribute."""
    both = c.slope @ covariances
    upper = torch.cat([covariances, both.mT], 2)
    lower = torch.cat([both, c.covariance + both @ c.slope.mT], 2)
    return torch.cat([means, c.mean], 1), torch.cat([upper, lower], 1)


FINE = 0.1
"""Of a channel's deviation in the map: smaller differences hardly hinder a merge or tell answers apart."""
_SMALL = 1e-3  # of a metre for a deviation: partners of a merge are neighbours in space


def joint_moments(
    attributes: Attributes, weights: Tensor, means: Tensor, covariances: Tensor
) -> tuple[Tensor, Tensor]:
    """Means (K, F) and covariances of the positions and all numbers of K components, for choosing merges.

    A channel is measured in its deviation in the map, which becomes a millimetre, and has a noise of a tenth
    of it. The Kullback–Leibler divergence does not depend on units. Components without values have the
    moments of all.
    """
    dim = means.shape[1]
    for c in attributes.channels.values():
        if not isinstance(c, Numbers):
            continue
        middle, variance = overall(c, weights)
        scale = _SMALL / variance.sqrt().clamp_min(1e-30)
        has = (c.share > 0)[:, None]
        mean = torch.where(has, (c.mean - middle) * scale, 0.0)
        slope = torch.where(has[..., None], c.slope * scale[:, None], 0.0)
        noise = c.covariance * scale[:, None] * scale
        unknown = torch.diag(torch.full_like(scale, _SMALL**2))
        noise = torch.where(has[..., None], noise + FINE**2 * unknown, unknown)
        padded = slope.new_zeros(len(slope), slope.shape[1], means.shape[1])
        padded[:, :, :dim] = slope
        means, covariances = _joint(Numbers(c.share, mean, padded, noise), means, covariances)
    return means, covariances


def overall(c: Channel, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance (A,) of a channel in K components with supports (K,), or of each label's probability;
    of numbers 0 and 1 if no component has any."""
    if isinstance(c, Labels):
        total = weights @ c.share
        mean = _ratio(total, total.sum())
        return mean, mean * (1 - mean)
    weight = weights * c.share
    total = weight.sum()
    mean = _ratio(weight @ c.mean, total)
    around = c.covariance.diagonal(dim1=1, dim2=2) + (c.mean - mean).square()
    return mean, torch.where(total > 0, _ratio(weight @ around, total), 1.0)


def _ratio(values: Tensor, total: Tensor) -> Tensor:
    """values (n, …) / total (n,); 0 where the total is."""
    return values / total.clamp_min(torch.finfo(total.dtype).tiny).view(-1, *[1] * (values.ndim - 1))
