"""Attributes of components: moments of channels such as colour, jointly with the position, and label shares.

A component whose points p have values a is one Gaussian of (p, a). It is stored as the regression of a on p:

    a | p ~ N(m + G (p − μ), R),  G = C_ap Σ⁻¹,  R = C_aa − G C_ap ᵀ,

so a painted wall has a gradient, and merging preserves the moments of (p, a). A component counts how many of
its points have each label. Both are relative to the support of the component.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import unpack_symmetric

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
        return cls({name: kinds[frozenset(found)](**found) for name, found in parts.items()})

    def changed(self, change: Callable[[Tensor], Tensor]) -> Attributes:
        """The attributes with `change` applied to each tensor."""
        return Attributes({name: type(c)(*map(change, c)) for name, c in self.channels.items()})

    def selected(self, rows: Tensor) -> Attributes:
        """Those of some components (J,), in that order."""
        return self._of_rows(lambda value: value[rows])

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
        found: dict[str, Channel] = {}
        for name in dict.fromkeys(name for part in parts for name in part.channels):
            given = [part.channels.get(name) for part in parts]
            found[name] = _joined(name, given, sizes)
        return cls(found)

    def turned(self, rotation: Tensor) -> Attributes:
        """The attributes of components turned by a rotation (D, D), or by one each (K, D, D)."""
        return Attributes(
            {
                name: c._replace(slope=c.slope @ rotation.mT) if isinstance(c, Numbers) else c
                for name, c in self.channels.items()
            }
        )

    def where(self, chosen: Tensor, other: Attributes) -> Attributes:
        """These attributes where `chosen` (K,), else others with the same channels."""

        def either(one: Tensor, two: Tensor) -> Tensor:
            return torch.where(chosen.view(-1, *[1] * (one.ndim - 1)), one, two)

        found: dict[str, Channel] = {}
        for name, c in self.channels.items():
            both = zip(c._fields, c, other.channels[name], strict=True)
            found[name] = type(c)(*(a if part == _LABELS else either(a, b) for part, a, b in both))
        return Attributes(found)

    def checked(self, k: int, dim: int) -> Attributes:
        """These attributes, if their shapes and values are those of K components in D dimensions; otherwise
        raises `InvalidArgumentError`."""
        for name, c in self.channels.items():
            width = c.mean.shape[-1] if isinstance(c, Numbers) else len(c.labels)
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
            if bool((c.share < 0).any()):
                raise InvalidArgumentError(f"attributes {name}.share is negative.")
            if isinstance(c, Labels) and bool((c.labels.diff() <= 0).any()):
                raise InvalidArgumentError(f"attributes {name}.labels do not increase.")
        return self


def _joined(name: str, given: Sequence[Channel | None], sizes: Sequence[int]) -> Channel:
    """One channel of several parts."""
    known = [c for c in given if c is not None]
    first = known[0]
    if any(type(c) is not type(first) for c in known):
        raise InvalidArgumentError(f"attributes {name!r} are numbers in some scans and labels in others.")
    if isinstance(first, Labels):
        labels = torch.unique(torch.cat([c.labels for c in known if isinstance(c, Labels)]))
        shares = []
        for c, n in zip(given, sizes, strict=True):
            share = first.share.new_zeros(n, len(labels))
            if isinstance(c, Labels):
                share[:, torch.searchsorted(labels, c.labels)] = c.share
            shares.append(share)
        return Labels(torch.cat(shares), labels)
    if len({c[1].shape[1] for c in known}) > 1:
        raise InvalidArgumentError(
            f"attributes {name!r} have different numbers of columns in different scans."
        )
    parts = [
        c if c is not None else Numbers(*(v.new_zeros(n, *v.shape[1:]) for v in first))
        for c, n in zip(given, sizes, strict=True)
    ]
    return Numbers(*(torch.cat(values) for values in zip(*parts, strict=True)))


# -- learning --------------------------------------------------------------------------------------------


def of_scans(scans: Sequence[Mapping[str, Tensor]], sizes: Sequence[int]) -> dict[str, Tensor]:
    """The channels (N, …) of the points of several scans together, unknown where a scan lacks one.

    Raises `InvalidArgumentError` if a channel has different kinds or columns in the scans.
    """
    found = {}
    for name in dict.fromkeys(name for scan in scans for name in scan):
        first = next(scan[name] for scan in scans if name in scan)
        unknown = torch.nan if first.is_floating_point() else -1
        parts = [
            scan[name] if name in scan else first.new_full((n, *first.shape[1:]), unknown)
            for scan, n in zip(scans, sizes, strict=True)
        ]
        if len({(part.is_floating_point(), part.shape[1:]) for part in parts}) > 1:
            raise InvalidArgumentError(
                f"attributes {name!r} are numbers in some scans and labels in others, or have different "
                "numbers of columns; give one kind."
            )
        found[name] = torch.cat(parts)
    return found


def learned(
    channels: Mapping[str, Tensor], points: Tensor, owner: Tensor, means: Tensor, covariances: Tensor
) -> Attributes:
    """The attributes of K components.

    Args:
        channels: of the points, as in `Scan`.
        points: (N, D). owner: (N,) the component of each point, −1 for those without one.
        means, covariances: of the components.
    """
    if bool((owner < 0).any()):
        kept = owner >= 0
        points, owner = points[kept], owner[kept]
        channels = {name: values[kept] for name, values in channels.items()}
    total = torch.bincount(owner, minlength=len(means)).double()
    found: dict[str, Channel] = {}
    for name, values in channels.items():
        if values.is_floating_point():
            found[name] = _regression(values.double(), points, owner, means, covariances, total)
        else:
            found[name] = _label_shares(values, owner, total)
    return Attributes(found)


def _label_shares(values: Tensor, owner: Tensor, total: Tensor) -> Labels:
    known = values >= 0
    labels, code = torch.unique(values[known], return_inverse=True)
    counts = torch.bincount(owner[known] * len(labels) + code, minlength=len(total) * len(labels))
    return Labels(counts.view(len(total), len(labels)) / total.clamp_min(1)[:, None], labels)


def _regression(
    values: Tensor, points: Tensor, owner: Tensor, means: Tensor, covariances: Tensor, total: Tensor
) -> Numbers:
    """The regression of values (N, A), NaN where unknown, on the positions of the points of each component.

    A few points do not show a slope: the prior adds points without one. The deviations of a component with
    few points are close to those of all.
    """
    known = torch.isfinite(values).all(1)
    if not bool(known.all()):
        values, points, owner = values[known], points[known], owner[known]
    (k, dim), width = means.shape, values.shape[1]
    n = torch.bincount(owner, minlength=k).double()
    middle = values.mean(0) if len(values) else values.new_zeros(width)
    joint = torch.cat([points - means[owner], values - middle], 1)
    rows, columns = torch.triu_indices(dim + width, dim + width, device=joint.device)
    features = torch.cat([joint, joint[:, rows] * joint[:, columns]], 1)
    sums = features.new_zeros(k, features.shape[1]).index_add_(0, owner, features)
    first, second = (sums / n.clamp_min(1)[:, None]).split([dim + width, len(rows)], 1)
    square = unpack_symmetric(second, dim + width) - first[:, :, None] * first[:, None]
    at, spread = first[:, :dim], square[:, :dim, :dim]
    both, own = square[:, dim:, :dim], square[:, dim:, dim:]
    prior = covariances * (_SLOPE_PRIOR / n.clamp_min(1))[:, None, None]
    slope = torch.linalg.solve(spread + prior, both.mT).mT
    cross = slope @ both.mT
    left = own - cross - cross.mT + slope @ spread @ slope.mT
    usual = (n[:, None, None] * left).sum(0) / n.sum().clamp_min(1)
    weight = (n / (n + _NOISE_PRIOR))[:, None, None]
    mean = first[:, dim:] + middle - (slope @ at[:, :, None])[:, :, 0]
    has = (n > 0).double()
    return Numbers(
        n / total.clamp_min(1),
        mean * has[:, None],
        slope * has[:, None, None],
        (weight * left + (1 - weight) * usual) * has[:, None, None],
    )


# -- merging ---------------------------------------------------------------------------------------------


def merged(
    attributes: Attributes,
    labels: Tensor,
    weights: Tensor,
    before: tuple[Tensor, Tensor],
    after: tuple[Tensor, Tensor],
) -> Attributes:
    """The attributes of components that are merged by label (K,), whose joint moments are preserved.

    Args:
        weights: (K,) supports.
        before, after: means and covariances, before and after the merge.
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
        (means, covariances), width = before, c.mean.shape[1]
        weight = weights * c.share
        known = summed(weight)
        center = _ratio(summed(weight[:, None] * torch.cat([means, c.mean], 1)), known)
        both = c.slope @ covariances
        joint = torch.cat(
            [torch.cat([covariances, both.mT], 2), torch.cat([both, c.covariance + both @ c.slope.mT], 2)], 1
        )
        away = torch.cat([means, c.mean], 1) - center[labels]
        joint = joint + away[:, :, None] * away[:, None]
        joint = _ratio(summed(weight[:, None, None] * joint), known)
        dim = means.shape[1]
        spread = torch.where((known > 0)[:, None, None], joint[:, :dim, :dim], after[1])
        slope = torch.linalg.solve(spread, joint[:, :dim, dim:]).mT
        left = joint[:, dim:, dim:] - slope @ joint[:, :dim, dim:]
        shift = (slope @ (after[0] - center[:, :dim])[:, :, None])[:, :, 0]
        has = (known > 0).to(shift)
        mean = (center[:, dim : dim + width] + shift) * has[:, None]
        found[name] = Numbers(_ratio(known, total), mean, slope * has[:, None, None], (left + left.mT) / 2)
    return Attributes(found)


def _ratio(values: Tensor, total: Tensor) -> Tensor:
    """values (n, …) / total (n,); 0 where the total is."""
    return values / total.clamp_min(torch.finfo(total.dtype).tiny).view(-1, *[1] * (values.ndim - 1))
