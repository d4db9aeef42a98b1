"""Points whose truth is known from held-out beams."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.files import write_bytes
from gmmtorch.occupancy.voxels.blocks import BlockEvidence
from gmmtorch.scan import Scan

FREE, OCCUPIED, UNKNOWN = 0, 1, 2
FreePoints = Literal["uniform", "near_surface", "clear"]


@dataclass(frozen=True)
class Queries:
    """points (M, D), world metres; labels (M,) int64: 0 free, 1 occupied, 2 never seen in training."""

    points: Tensor
    labels: Tensor

    def of(self, label: int) -> Tensor:
        """Which points (M,) have this label."""
        return self.labels == label


def check_free(free: str) -> None:
    """Raises for a choice of free points that is not known."""
    if free not in get_args(FreePoints):
        raise InvalidArgumentError(f"free={free!r} is not one of {', '.join(get_args(FreePoints))}.")


def test_beams(scans: Sequence[Scan], max_beams: int, seed: int) -> tuple[Tensor, Tensor]:
    """Origins and ends (B, D) of the beams of the test scans that hit something.

    More than `max_beams` are thinned to that many at random.
    """
    # On the CPU, where the random numbers are: so every device is asked about the same points.
    ends = torch.cat([scan.points.double().cpu() for scan in scans])
    origins = torch.cat([scan.origin.double().cpu().expand(scan.points.shape[0], -1) for scan in scans])
    measured = (ends != origins).any(1)
    origins, ends = origins[measured], ends[measured]
    if ends.shape[0] == 0:
        raise InvalidArgumentError(
            "The held-out scans have no beam that hit anything, so there is nothing to test on; "
            "check dataset.max_range, or change evaluation.test_every."
        )
    if ends.shape[0] > max_beams:
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(ends.shape[0], generator=generator)[:max_beams].sort().values
        origins, ends = origins[chosen], ends[chosen]
    return origins, ends


def hit_and_free(origins: Tensor, ends: Tensor, free: FreePoints, resolution: float, seed: int) -> Queries:
    """One hit and one free point a beam.

    The free point is uniform along the beam; or half to two cells before the hit ("near_surface",
    which shows how thick a map's surfaces are), never before the sensor; or uniform, but left out
    within one cell of the hit ("clear": a share of uniform points is too near to be told apart).
    """
    check_free(free)
    generator = torch.Generator().manual_seed(seed)
    uniform = torch.rand(ends.shape[0], generator=generator, dtype=torch.float64)
    if free == "near_surface":
        length = (ends - origins).norm(dim=1)
        uniform = (1 - (0.5 + 1.5 * uniform) * resolution / length).clamp_min(0)
    points = origins + (ends - origins) * uniform[:, None]
    if free == "clear":
        points = points[(ends - points).norm(dim=1) > resolution]
    labels = torch.cat([torch.full((len(ends),), OCCUPIED), torch.full((len(points),), FREE)])
    return Queries(torch.cat([ends, points]), labels)


def touched(scans: Sequence[Scan], resolution: float) -> BlockEvidence:
    """Evidence in every cell that a beam of the scans touched, the ends of empty beams included."""
    seen = BlockEvidence(resolution, scans[0].dim)
    for scan in scans:
        ends = torch.cat([scan.points, scan.no_return]).double().cpu()
        seen.add_rays(scan.origin.double().cpu().expand_as(ends), ends)
    return seen


def unseen(origins: Tensor, ends: Tensor, seen: BlockEvidence, seed: int) -> Queries:
    """Points 2 to 12 cells behind test hits that no training ray came near.

    `seen` is what `touched` makes of the training scans at the resolution in question; a point
    stays only if its cell and all its neighbours (8 in 2D, 26 in 3D) have no evidence.
    """
    generator = torch.Generator().manual_seed(seed + 1)
    behind = 2 + 10 * torch.rand(ends.shape[0], generator=generator, dtype=torch.float64)
    direction = (ends - origins) / (ends - origins).norm(dim=1, keepdim=True)
    points = ends + direction * (behind * seen.resolution)[:, None]
    untouched = torch.ones(points.shape[0], dtype=torch.bool)
    for offset in itertools.product((-1, 0, 1), repeat=points.shape[1]):
        shift = torch.tensor(offset, dtype=torch.float64) * seen.resolution
        hits, misses = seen.evidence_at(points + shift)
        untouched &= hits + misses == 0
    kept = points[untouched]
    return Queries(kept, torch.full((kept.shape[0],), UNKNOWN))


def save_queries(
    path: str | Path, by_resolution: dict[float, Queries], train: Sequence[int], test: Sequence[int]
) -> None:
    """Write the very test points as NPZ: points, labels, resolution, train_scans, test_scans.

    `resolution` (M,) says at which resolution a point is asked about, and is 0 for points that are
    the same at all of them.
    """
    each = list(by_resolution.items())
    first = each[0][1]
    shared = all(torch.equal(first.points, queries.points) for _, queries in each)
    groups = [(0.0, first)] if shared else each
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        points=torch.cat([queries.points for _, queries in groups]).numpy(),
        labels=torch.cat([queries.labels for _, queries in groups]).numpy().astype(np.int64),
        resolution=np.concatenate([np.full(len(queries.labels), r) for r, queries in groups]),
        train_scans=np.asarray(train, dtype=np.int64),
        test_scans=np.asarray(test, dtype=np.int64),
    )
    path = Path(path)
    write_bytes(path if path.suffix == ".npz" else path.with_name(path.name + ".npz"), buffer.getvalue())
