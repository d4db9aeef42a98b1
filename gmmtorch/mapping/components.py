"""Components: Gaussians of a map, with the sensor origins that observed them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor, naming_device
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.linalg import argsort, check_symmetric, on_cpu, safe_cholesky
from gmmtorch.mapping.attributes.moments import Attributes
from gmmtorch.occupancy import Cones
from gmmtorch.scan import check_positions, extent

DTYPES = dict.fromkeys(("ids", "seen_by", "seen_from"), torch.int64) | {"max_range": torch.bool}
_PER_COMPONENT = ("means", "covariances", "support", "max_range", "ids")
_PER_VIEWPOINT = ("seen_by", "seen_from", "seen_count")

UNNUMBERED = -1
"""Sequence number, in `ids`, of a component that is new or changed. The owner of the map numbers it."""


@dataclass(frozen=True, eq=False, repr=False)
class Components:
    """K components in the world frame (m), S sensor origins, and E viewpoints.

    A viewpoint is a component, an origin that observed it, and the number of points observed from there.

    means (K, D): metres.
    covariances (K, D, D): m².
    support (K,): number of points of each component.
    max_range (K,) bool: the component describes ends of no-return beams, not a surface.
    ids (K, 2): robot, sequence number.
    origins (S, D): sensor positions.
    seen_by, seen_from, seen_count (E,): `seen_count[e]` points of component `seen_by[e]` were observed from
        `origins[seen_from[e]]`. The counts of a component add up to its support.
    attributes: channels such as colour; none in most maps.

    Fields can be arrays, lists or tensors; they become float64, int64 and bool tensors.
    """

    means: Tensor
    covariances: Tensor
    support: Tensor
    max_range: Tensor
    ids: Tensor
    origins: Tensor
    seen_by: Tensor
    seen_from: Tensor
    seen_count: Tensor
    attributes: Attributes = field(default_factory=Attributes, kw_only=True)

    def __post_init__(self) -> None:
        for name, given in self.tensors().items():
            value = as_tensor(given, name, DTYPES.get(name, torch.float64))
            if value is not given:
                object.__setattr__(self, name, value)

    def tensors(self) -> dict[str, Tensor]:
        """The fields by name, without attributes."""
        return {name: value for name, value in vars(self).items() if name != "attributes"}

    def __repr__(self) -> str:
        n_bytes = sum(
            value.nbytes for value in (*self.tensors().values(), *self.attributes.tensors().values())
        )
        channels = f" with {', '.join(self.attributes.channels)}" if self.attributes else ""
        return (
            f"Components({len(self)} in {self.dim}D{channels} seen from {self.origins.shape[0]} origins"
            f"{extent(self.means)}, {float(self.support.sum()):.6g} points, {n_bytes} bytes in memory, "
            f"{self.means.device})"
        )

    @classmethod
    def empty(cls, dim: int, device: torch.device | str | None = None) -> Components:
        """No components in `dim` dimensions."""
        real, index, flag = (
            torch.empty(0, dtype=dtype, device=device) for dtype in (torch.float64, torch.int64, torch.bool)
        )
        places, ids = real.view(0, dim), index.view(0, 2)
        return cls(places, real.view(0, dim, dim), real, flag, ids, places, index, index, real)

    @classmethod
    def given(
        cls,
        means: ArrayLike,
        covariances: ArrayLike,
        support: ArrayLike,
        origins: ArrayLike | Sequence[Sequence[tuple[ArrayLike, float]]],
        max_range: ArrayLike | None,
        robot: int,
    ) -> Components:
        """Components for the arguments of `GaussianMap.from_components`, numbered from 0."""
        mean, weight = as_tensor(means, "means", torch.float64), as_tensor(support, "support", torch.float64)
        if mean.ndim != 2 or mean.shape[1] not in (2, 3):
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, 2) or (K, 3).")
        k = mean.shape[0]
        if weight.shape != (k,):
            raise InvalidArgumentError(f"support has shape {tuple(weight.shape)}; expected ({k},).")
        flags = as_tensor([False] * k if max_range is None else max_range, "max_range", torch.bool)
        ids = torch.stack([torch.full((k,), robot), torch.arange(k)], 1)
        covariance = as_tensor(covariances, "covariances", torch.float64)
        parts = (covariance, weight, flags, ids, *_viewpoints(origins, weight.cpu(), mean.shape[1]))
        # Copies: later writes to the given arrays do not change the components.
        return cls(mean.clone(), *(part.to(mean.device, copy=True) for part in parts))

    @property
    def dim(self) -> int:
        """2 or 3."""
        return self.means.shape[1]

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def concatenate(cls, parts: Sequence[Components]) -> Components:
        """All components and origins of the parts, in order."""
        parts = [part for part in parts if part.origins.shape[0] or len(part)] or parts[:1]
        if len(parts) == 1:
            return parts[0]
        seen_by, seen_from = [], []
        n_components = n_origins = 0
        for part in parts:
            seen_by.append(part.seen_by + n_components if n_components else part.seen_by)
            seen_from.append(part.seen_from + n_origins if n_origins else part.seen_from)
            n_components += len(part)
            n_origins += part.origins.shape[0]
        names = [name for name in TENSORS if name not in ("seen_by", "seen_from")]
        joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
        attributes = Attributes.concatenate(
            [part.attributes for part in parts], [len(part) for part in parts]
        )
        whole = {**joined, "seen_by": torch.cat(seen_by), "seen_from": torch.cat(seen_from)}
        return cls(**whole, attributes=attributes)

    def to(self, device: torch.device | str) -> Components:
        """The components on a device."""
        with naming_device(device):
            if self.means.device == torch.device(device):
                return self
            if torch.device(device).type == "cpu":
                return self.on_cpu()
            return self.changed(lambda value: value.to(device, non_blocking=True))

    def changed(self, change: Callable[[Tensor], Tensor]) -> Components:
        """The components with `change` applied to each tensor."""
        return Components(*map(change, self.tensors().values()), attributes=self.attributes.changed(change))

    def on_cpu(self) -> Components:
        """The components on the CPU, without gradients."""
        given = (*self.tensors().values(), *self.attributes.tensors().values())
        if not any(value.requires_grad or value.device.type != "cpu" for value in given):
            return self
        return Components(*on_cpu(*self.tensors().values()), attributes=self.attributes.on_cpu())

    def cones(self) -> Cones:
        """One cone for each viewpoint: the argument of the evidence functions."""
        return Cones(
            self.means[self.seen_by],
            self.covariances[self.seen_by],
            self.origins[self.seen_from],
            self.seen_count,
            self.max_range[self.seen_by],
        )

    def rearranged(self, order: Tensor) -> Components:
        """The components in another order (K,)."""
        rank = torch.empty_like(order)
        rank[order] = torch.arange(len(order), device=order.device)
        moved = {name: getattr(self, name)[order] for name in _PER_COMPONENT}
        return replace(self, **moved, seen_by=rank[self.seen_by], attributes=self.attributes.selected(order))

    def selected(self, rows: Tensor) -> Components:
        """The components of distinct rows (J,), in that order, with all origins."""
        place = torch.full_like(self.max_range, -1, dtype=torch.int64)
        place[rows] = torch.arange(len(rows), device=rows.device)
        kept = (place[self.seen_by] >= 0).nonzero().squeeze(1)
        kept = kept[argsort(place[self.seen_by[kept]])]
        chosen = {name: getattr(self, name)[rows] for name in _PER_COMPONENT}
        chosen["seen_by"] = place[self.seen_by[kept]]
        return replace(self.with_viewpoints(kept), **chosen, attributes=self.attributes.selected(rows))

    def split(self, ends: Sequence[int]) -> list[Components]:
        """The components up to each of the rising rows `ends`, from the one before, with all origins. Parts
        share memory with this, if its viewpoints are sorted by component."""
        by, each = self.seen_by, self
        if not bool((by[1:] >= by[:-1]).all()):
            each = self.with_viewpoints(argsort(by))
        begins, found = [0, *ends[:-1]], []
        places = torch.searchsorted(each.seen_by, by.new_tensor([begins, list(ends)])).tolist()
        for begin, end, first, last in zip(begins, ends, *places, strict=True):
            part = {name: getattr(each, name)[begin:end] for name in _PER_COMPONENT}
            part |= {name: getattr(each, name)[first:last] for name in ("seen_from", "seen_count")}
            attributes = self.attributes.selected(slice(begin, end))
            found.append(
                replace(each, **part, seen_by=each.seen_by[first:last] - begin, attributes=attributes)
            )
        return found

    def with_viewpoints(self, rows: Tensor) -> Components:
        """The components with these viewpoints (E′,), in that order."""
        return replace(self, **{name: getattr(self, name)[rows] for name in _PER_VIEWPOINT})

    def with_used_origins(self) -> Components:
        """The components without the origins that have no viewpoint."""
        used, seen_from = torch.unique(self.seen_from, return_inverse=True)
        return replace(self, origins=self.origins[used], seen_from=seen_from)

    def has_id(self, ids: ArrayLike | None) -> Tensor:
        """Which components (K,) have one of the ids (J, 2); None: all."""
        if ids is None:
            return torch.ones_like(self.max_range)
        wanted = as_tensor(ids, "ids", torch.int64, self.ids.device)
        wanted = wanted if wanted.numel() else wanted.reshape(0, 2)
        if wanted.ndim != 2 or wanted.shape[1] != 2:
            raise InvalidArgumentError(
                f"ids has shape {tuple(wanted.shape)}; expected (J, 2): robot, sequence."
            )
        # One number for each distinct id, so that pairs are compared in one sorted pass.
        _, number = torch.unique(torch.cat([self.ids, wanted]), dim=0, return_inverse=True)
        return torch.isin(number[: len(self)], number[len(self) :])

    def transformed(self, transform: Tensor, chosen: Tensor) -> Components:
        """The components `chosen` (K,) and their origins moved by a rigid motion (D+1, D+1)."""
        rotation, translation = transform[:-1, :-1], transform[:-1, -1]
        moved_viewpoint, rows = chosen[self.seen_by], chosen.nonzero().squeeze(1)
        origins = torch.cat([self.origins, self.origins @ rotation.T + translation])
        seen_from = self.seen_from + moved_viewpoint.long() * self.origins.shape[0]
        moved = replace(
            self,
            means=torch.where(chosen[:, None], self.means @ rotation.T + translation, self.means),
            covariances=torch.where(
                chosen[:, None, None], rotation @ self.covariances @ rotation.T, self.covariances
            ),
            origins=origins,
            seen_from=seen_from,
            attributes=self.attributes.replaced(rows, self.attributes.selected(rows).turned(rotation)),
        )
        return moved.with_used_origins()

    def checked(self) -> Components:
        """These components, if shapes, indices, signs and covariances are valid.

        Otherwise raises `InvalidArgumentError`, or `NumericalError` for an indefinite covariance.
        """
        if self.means.ndim != 2 or self.means.shape[1] not in (2, 3):
            raise InvalidArgumentError(
                f"means has shape {tuple(self.means.shape)}; expected (K, 2) or (K, 3)."
            )
        k, dim = self.means.shape
        n_viewpoints = self.seen_by.shape[0]
        expected = {
            "covariances": (k, dim, dim),
            "support": (k,),
            "max_range": (k,),
            "ids": (k, 2),
            "origins": (self.origins.shape[0], dim),
            "seen_by": (n_viewpoints,),
            "seen_from": (n_viewpoints,),
            "seen_count": (n_viewpoints,),
        }
        for name, shape in expected.items():
            value = getattr(self, name)
            if tuple(value.shape) != shape:
                raise InvalidArgumentError(f"{name} has shape {tuple(value.shape)}; expected {shape}.")
            if value.is_floating_point() and not bool(torch.isfinite(value).all()):
                raise InvalidArgumentError(f"{name} holds NaN or infinite values.")
        for name in ("means", "origins"):
            check_positions(name, getattr(self, name))
        for name, limit in (("seen_by", k), ("seen_from", self.origins.shape[0])):
            value = getattr(self, name)
            if value.numel() and not (int(value.min()) >= 0 and int(value.max()) < limit):
                raise InvalidArgumentError(f"{name} points outside its table of {limit} rows.")
        if bool((self.support < 0).any()) or bool((self.seen_count < 0).any()):
            raise InvalidArgumentError("support and counts must not be negative.")
        if k:
            safe_cholesky(check_symmetric(self.covariances, "covariances"))
        self.attributes.checked(k, dim)
        return self


TENSORS = tuple(part.name for part in fields(Components) if part.name != "attributes")
"""Names of the fields of `Components` that are tensors."""


def _viewpoints(
    origins: ArrayLike | Sequence[Sequence[tuple[ArrayLike, float]]], support: Tensor, dim: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The fields origins, seen_by, seen_from and seen_count for the `origins` of `from_components`."""
    k = support.shape[0]
    if len(origins) != k:
        raise InvalidArgumentError(
            f"origins has {len(origins)} entries for {k} components; give one for each."
        )
    if isinstance(origins, Tensor | np.ndarray) or k == 0 or _is_position(origins[0]):
        table = as_tensor(origins, "origins", torch.float64, "cpu") if k else support.new_zeros(0, dim)
        return table, torch.arange(k), torch.arange(k), support
    rows: list[Tensor] = []
    seen_by: list[int] = []
    counts: list[float] = []
    for component, viewpoints in enumerate(origins):
        total = sum(float(count) for _, count in viewpoints)
        if not total > 0 or min(float(count) for _, count in viewpoints) < 0:
            raise InvalidArgumentError(
                f"origins[{component}] needs counts of at least zero that add up to more than zero."
            )
        for origin, count in viewpoints:
            rows.append(as_tensor(origin, f"origins[{component}]", torch.float64, "cpu"))
            seen_by.append(component)
            counts.append(float(count) / total * float(support[component]))
            if rows[-1].shape != (dim,):
                raise InvalidArgumentError(
                    f"origins[{component}] holds a position of shape {tuple(rows[-1].shape)}; "
                    f"expected ({dim},)."
                )
    shares = torch.tensor(counts, dtype=torch.float64)
    return torch.stack(rows), torch.tensor(seen_by), torch.arange(len(seen_by)), shares


def _is_position(entry: Any) -> bool:
    """Whether an entry is a position (D,), and not a list of (position, count)."""
    try:
        return as_tensor(entry, "origins").ndim == 1
    except InvalidArgumentError:
        return False
