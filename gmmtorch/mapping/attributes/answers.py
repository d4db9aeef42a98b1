"""Prediction of attributes at points: regression on the components near each point (Gaussian mixture
regression: Ghahramani & Jordan, NIPS 1994)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.attributes.moments import FINE, Channel, Labels, overall
from gmmtorch.mapping.attributes.reflectivity import gain
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import box_around, portions
from gmmtorch.mapping.learning.rules import IntensityLaw
from gmmtorch.occupancy import whitening
from gmmtorch.scan import COLOUR, INTENSITY

CUTOFF = 4.0
"""Mahalanobis distance from a component up to which it predicts."""
_FARTHEST_SLOPE = 2.5  # deviations from the mean up to which a slope is followed


class Prediction(NamedTuple):
    """A channel at M points.

    mean, variance (M, A): of the numbers; of a channel of classes, the probability of each of `labels` and
        its variance. Where `known` (M,) is False no component is near: those of the whole map.
    labels (A,): of the classes; None for numbers.
    """

    mean: Tensor
    variance: Tensor
    known: Tensor
    labels: Tensor | None = None

    def to(self, device: torch.device) -> Prediction:
        """The prediction on a device."""
        labels = None if self.labels is None else self.labels.to(device)
        return Prediction(self.mean.to(device), self.variance.to(device), self.known.to(device), labels)

    @property
    def most_likely(self) -> Tensor:
        """The most likely label (M,); −1 where unknown. Raises `InvalidArgumentError` for numbers."""
        if self.labels is None:
            raise InvalidArgumentError("most_likely: the channel has numbers, not labels; use mean.")
        if not len(self.labels):
            return torch.full_like(self.known, -1, dtype=torch.int64)
        return torch.where(self.known, self.labels[self.mean.argmax(1)], -1)


def predictions(
    components: Components,
    points: Tensor,
    cutoff: float = CUTOFF,
    seen: tuple[IntensityLaw, Tensor] | None = None,
) -> dict[str, Prediction]:
    """Each channel of the components at points (M, D), float64, on their device. Differentiable.

    The surface components within `cutoff` deviations of a point predict it, weighted by
    support · share · N(x; μ, Σ), and a number also by 1/σ, the height of its density, so that of components
    that overlap those with the clearest value count most. The variance is that of the mixture of their
    predictions. Memory does not grow with the number of pairs of points and components. seen: the law of
    intensities, and the positions (M, D) of the sensors that measure them; None: reflectivities as they are.
    """
    if not components.attributes:
        return {}
    solid = components.selected((~components.max_range & (components.support > 0)).nonzero().squeeze(1))
    inside = torch.isfinite(points).all(1).nonzero().squeeze(1)
    asked = points[inside]
    white, log_norm = whitening(solid.covariances)
    height = solid.support.double().log() - log_norm
    channels, order = solid.attributes.channels, []
    found: dict[str, list[tuple[Tensor, Tensor, Tensor]]] = {name: [] for name in channels}
    usual = {name: overall(channel, solid.support) for name, channel in channels.items()}
    least = {name: FINE**2 * variance for name, (_, variance) in usual.items()}
    boxes = box_around(solid, cutoff**2)
    for part, some in portions(asked.detach(), max(1, len(solid)), boxes) if len(asked) else ():
        offset = asked[part, None] - solid.means[some]
        apart = torch.einsum("kij,nkj->nki", white[some], offset)
        squared = apart.square().sum(-1)
        level = torch.where(squared < cutoff**2, height[some] - 0.5 * squared, -torch.inf)
        top = level.detach().amax(1, keepdim=True) if len(some) else level.new_zeros(len(part), 1)
        weight = torch.exp(level - torch.where(top.isfinite(), top, 0.0))
        length = squared.clamp_min(1e-12).sqrt()
        offset = offset * (_FARTHEST_SLOPE / length).clamp_max(1)[..., None]
        order.append(part)
        for name, channel in channels.items():
            factor = None
            if seen is not None and name == INTENSITY:
                rays = (asked - seen[1][inside])[part, None].expand_as(offset)
                factor = gain(seen[0], rays, white[some])
            found[name].append(_mixed(channel, some, weight, offset, factor, least[name]))
    rows = inside[torch.cat(order)] if order else inside
    return {
        name: _placed(name, channel, usual[name], found[name], rows, points)
        for name, channel in channels.items()
    }


def _mixed(
    channel: Channel, some: Tensor, weight: Tensor, offset: Tensor, factor: Tensor | None, least: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Mean and variance (n, A) of the mixture of the predictions of some components, times `factor` (n, J),
    and their total weight (n,), for weight (n, J) and offset (n, J, D) from their means. least: variance (A,)
    that is added in weights."""
    if isinstance(channel, Labels):
        total = weight @ channel.share[some].sum(1)
        mean = (weight @ channel.share[some]) / total.clamp_min(torch.finfo(total.dtype).tiny)[:, None]
        return mean, mean * (1 - mean), total
    weight = weight * channel.share[some]
    total = weight.sum(1)
    noise = channel.covariance[some].diagonal(dim1=1, dim2=2)
    weight = weight[..., None] / (noise + least).sqrt()
    share = weight / weight.sum(1, keepdim=True).clamp_min(torch.finfo(total.dtype).tiny)
    own = channel.mean[some] + torch.einsum("kad,nkd->nka", channel.slope[some], offset)
    if factor is not None:
        own, noise = own * factor[..., None], noise * factor.square()[..., None]
    mean = (share * own).sum(1)
    return mean, (share * ((own - mean[:, None]).square() + noise)).sum(1), total


def _placed(
    name: str,
    channel: Channel,
    usual: tuple[Tensor, Tensor],
    parts: list[tuple[Tensor, Tensor, Tensor]],
    rows: Tensor,
    points: Tensor,
) -> Prediction:
    """The prediction for all points from that for some rows of them, in portions."""
    mean, variance = (value.expand(len(points), -1).clone() for value in usual)
    known = torch.zeros(len(points), dtype=torch.bool, device=points.device)
    if parts:
        own_mean, own_variance, total = (torch.cat(values) for values in zip(*parts, strict=True))
        known = known.index_copy(0, rows, total > 0)
        seen = rows[total > 0]
        mean = mean.index_copy(0, seen, own_mean[total > 0])
        variance = variance.index_copy(0, seen, own_variance[total > 0])
    if name == COLOUR:
        mean = mean.clamp(0, 1)
    return Prediction(mean, variance, known, channel.labels if isinstance(channel, Labels) else None)
