"""What records say of a map: components with the counts that others added, where corrections put them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping.components import Components
from gmmtorch.sharing.messages.record_messages import CorrectionMessage
from gmmtorch.sharing.replica.intervals import Ints
from gmmtorch.sharing.replica.record_keys import robot_of


def gains(components: Components, gain: Tensor) -> Components:
    """What components (K,) gain by so many points (K,): support and counts are the gain alone.

    Sightings gain in proportion to what they have.
    """
    ratio = torch.where(components.support > 0, gain / components.support, 0.0)
    several = torch.bincount(components.seen_by, minlength=len(components)).clamp_min(1)
    alike = torch.where(components.support > 0, 0.0, gain / several)  # of what had no points
    seen_count = components.seen_count * ratio[components.seen_by] + alike[components.seen_by]
    return replace(components, support=gain, seen_count=seen_count)


def with_gains(components: Components, gain: Tensor) -> Components:
    """Components (K,) with so many points (K,) more."""
    more = gains(components, gain)
    return replace(
        components,
        support=components.support + more.support,
        seen_count=components.seen_count + more.seen_count,
    )


def current(records: Sequence[CorrectionMessage]) -> list[CorrectionMessage]:
    """The correction of each scan that counts, by robot and scan."""
    latest: dict[tuple[int, int], CorrectionMessage] = {}
    for record in sorted(records, key=lambda r: (r.version, r.key)):
        latest[robot_of(record.key), record.scan] = record
    return [latest[name] for name in sorted(latest)]


def corrected(components: Components, keys: Ints, records: Sequence[CorrectionMessage]) -> Components:
    """Components (K,) where the corrections of their scans put them, their origins with them.

    A component of two scans goes with the later one.
    """
    motions = [record for record in current(records) if record.dim == components.dim]
    which = np.full(len(keys), -1)
    for number, record in enumerate(motions):
        which[record.moved.contains(keys)] = number
    if not (which >= 0).any():
        return components
    still = torch.eye(components.dim + 1, dtype=torch.float64)
    motion = torch.stack([*(record.transform() for record in motions), still])[which]  # (K, D+1, D+1)
    means, seen_at = components.means, components.origins[components.seen_from]
    turn = motion[:, :-1, :-1]
    covariances = turn @ components.covariances @ turn.transpose(1, 2)
    origins, seen_from = torch.unique(_moved(motion[components.seen_by], seen_at), dim=0, return_inverse=True)
    moves = torch.from_numpy(which >= 0)
    return replace(
        components,
        means=torch.where(moves[:, None], _moved(motion, means), means),
        covariances=torch.where(
            moves[:, None, None], (covariances + covariances.transpose(1, 2)) / 2, components.covariances
        ),
        origins=origins,
        seen_from=seen_from,
    )


def information(components: Components) -> Tensor:
    """About how much space (K,) each component tells of, m³ or m²: its face times its distance from the
    sensor. What is lost or late of a large one that was seen from afar leaves the largest hole."""
    deviation = torch.linalg.eigvalsh(components.covariances).clamp_min(0).sqrt()
    face = deviation[:, 1:].prod(1)
    apart = components.means[components.seen_by] - components.origins[components.seen_from]
    reach = face.new_zeros(len(face)).scatter_reduce_(0, components.seen_by, apart.norm(dim=1), "amax")
    return face * reach


def _moved(motion: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) by motions (N, D+1, D+1)."""
    return (motion[:, :-1, :-1] @ points[:, :, None]).squeeze(2) + motion[:, :-1, -1]
