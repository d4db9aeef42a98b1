"""The components that follow from the records: with the points of all counters, moved by the corrections."""

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
    """Components (K,) whose support and counts are the points (K,) that they gain.

    The points are distributed over a component's viewpoints in proportion to their counts.
    """
    ratio = torch.where(components.support > 0, gain / components.support, 0.0)
    several = torch.bincount(components.seen_by, minlength=len(components)).clamp_min(1)
    equal = torch.where(components.support > 0, 0.0, gain / several)  # for components without support
    seen_count = components.seen_count * ratio[components.seen_by] + equal[components.seen_by]
    return replace(components, support=gain, seen_count=seen_count)


def with_gains(components: Components, gain: Tensor) -> Components:
    """Components (K,) with points (K,) added to their support and counts."""
    more = gains(components, gain)
    return replace(
        components,
        support=components.support + more.support,
        seen_count=components.seen_count + more.seen_count,
    )


def latest(records: Sequence[CorrectionMessage]) -> list[CorrectionMessage]:
    """The correction of each scan with the highest version, then key; sorted by robot and scan."""
    found: dict[tuple[int, int], CorrectionMessage] = {}
    for record in sorted(records, key=lambda r: (r.version, r.key)):
        found[robot_of(record.key), record.scan] = record
    return [found[scan] for scan in sorted(found)]


def corrected(components: Components, keys: Ints, records: Sequence[CorrectionMessage]) -> Components:
    """Components (K,) moved by the corrections of their scans, with their origins.

    A component of two scans is moved by the correction of the scan with the higher number.
    """
    motions = [record for record in latest(records) if record.dim == components.dim]
    which = np.full(len(keys), -1)
    for number, record in enumerate(motions):
        which[record.moved.contains(keys)] = number
    if not (which >= 0).any():
        return components
    identity = torch.eye(components.dim + 1, dtype=torch.float64)
    motion = torch.stack([*(record.transform() for record in motions), identity])[which]  # (K, D+1, D+1)
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
    """The approximate space (K,), m³ or m², that each component shows: its face times its sensor distance.

    Large components seen from afar leave the largest hole in a map that lacks them.
    """
    deviation = torch.linalg.eigvalsh(components.covariances).clamp_min(0).sqrt()
    face = deviation[:, 1:].prod(1)
    apart = components.means[components.seen_by] - components.origins[components.seen_from]
    reach = face.new_zeros(len(face)).scatter_reduce_(0, components.seen_by, apart.norm(dim=1), "amax")
    return face * reach


def _moved(motion: Tensor, points: Tensor) -> Tensor:
    """Points (N, D) transformed by motions (N, D+1, D+1)."""
    return (motion[:, :-1, :-1] @ points[:, :, None]).squeeze(2) + motion[:, :-1, -1]
