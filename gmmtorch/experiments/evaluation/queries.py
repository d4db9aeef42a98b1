"""The held-out test: which scans train a map, and the test points whose true state the other scans show."""

from __future__ import annotations

import io
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation.protocol_options import FreePoints, Removal
from gmmtorch.files import write_bytes
from gmmtorch.occupancy import SparseEvidence
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan


def split_indices(n_scans: int, test_every: int) -> tuple[list[int], list[int]]:
    """Indices of training and test scans: 0, n, 2n, … are held out."""
    if n_scans < 2:
        raise InvalidArgumentError(
            f"The data set has {n_scans} scans; at least 2 are needed: one for training and one for the test."
        )
    test = list(range(0, n_scans, test_every))
    held_out = set(test)
    return [i for i in range(n_scans) if i not in held_out], test


def keep_share(scans: Sequence[Scan], share: float, removal: Removal, seed: int) -> list[Scan]:
    """Keeps a random share of the beams of each scan, or a random share of the scans.

    With the same seed, a smaller share is a subset of a larger one.
    """
    if share == 1:
        return list(scans)
    generator = torch.Generator().manual_seed(seed)
    if removal == "scans":
        rank = torch.rand(len(scans), generator=generator).argsort().argsort()
        return [scan for scan, r in zip(scans, rank.tolist(), strict=True) if r < max(1, share * len(scans))]
    return [scan.select(torch.rand(scan.n_beams, generator=generator) < share) for scan in scans]


def pose_perturbations(scans: Sequence[Scan], noise: Sequence[float], seed: int) -> list[torch.Tensor]:
    """A random rigid motion (D+1, D+1) of each scan about its sensor origin, float64.

    `noise`: standard deviations of the translation along each axis (m) and of the rotation about each
    axis (rad).
    """
    shift, angle = noise
    generator = torch.Generator().manual_seed(seed)
    motions = []
    for scan in scans:
        dim = scan.dim
        translation = torch.randn(dim, generator=generator, dtype=torch.float64) * shift
        turn = torch.randn(1 if dim == 2 else 3, generator=generator, dtype=torch.float64) * angle
        rotation, origin = Pose.from_turn(turn).rotation, scan.origin.double().cpu()
        motions.append(Pose(rotation, origin + translation - rotation @ origin).matrix)
    return motions


def perturb_poses(scans: Sequence[Scan], noise: Sequence[float], seed: int) -> list[Scan]:
    """Each scan moved by its motion of `pose_perturbations`; unchanged if both deviations are zero."""
    if not any(noise):
        return list(scans)
    motions = pose_perturbations(scans, noise, seed)
    return [scan.transformed(motion) for scan, motion in zip(scans, motions, strict=True)]


FREE, OCCUPIED, UNKNOWN = 0, 1, 2


@dataclass(frozen=True)
class Queries:
    """Test points (M, D), world metres, and labels (M,) int64: 0 free, 1 occupied, 2 unknown."""

    points: Tensor
    labels: Tensor

    def of(self, label: int) -> Tensor:
        """Mask (M,) of the points with this label."""
        return self.labels == label

    def split(self, values: Tensor) -> tuple[Tensor, Tensor]:
        """The values of occupied and of free points, of values (M,)."""
        return values[self.of(OCCUPIED)], values[self.of(FREE)]


def test_beams(scans: Sequence[Scan], max_beams: int, seed: int) -> tuple[Tensor, Tensor]:
    """Origins and ends (B, D) of the return beams of the test scans.

    Draws a random subset of `max_beams` if there are more.
    """
    # The random numbers are drawn on the CPU, so that the test points are the same on every device.
    ends = torch.cat([scan.points.double().cpu() for scan in scans])
    origins = torch.cat([scan.origin.double().cpu().expand(scan.points.shape[0], -1) for scan in scans])
    measured = (ends != origins).any(1)
    origins, ends = origins[measured], ends[measured]
    if ends.shape[0] == 0:
        raise InvalidArgumentError(
            "The held-out scans have no return beams, so there are no test points; check ‹max_range›, "
            "or change ‹test_every›."
        )
    if ends.shape[0] > max_beams:
        generator = torch.Generator().manual_seed(seed)
        chosen = torch.randperm(ends.shape[0], generator=generator)[:max_beams].sort().values
        origins, ends = origins[chosen], ends[chosen]
    return origins, ends


def hit_and_free(origins: Tensor, ends: Tensor, free: FreePoints, resolution: float, seed: int) -> Queries:
    """One occupied point (the hit) and one free point for each beam.

    free: "uniform": uniform along the beam. "near_surface": 0.5 to 2 cells before the hit, but not behind the
    sensor; this measures how thick a map's surfaces are. "clear": uniform, but points within one cell of the
    hit are left out, because a cell can contain both.
    """
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


def ray_evidence(scans: Sequence[Scan], resolution: float) -> SparseEvidence:
    """Evidence in every cell that a beam of the scans crosses, no-return beams included."""
    seen = SparseEvidence(resolution, scans[0].dim)
    for scan in scans:
        ends = torch.cat([scan.points, scan.no_return]).double().cpu()
        seen.add_rays(scan.origin.double().cpu().expand_as(ends), ends)
    return seen


def unseen(origins: Tensor, ends: Tensor, seen: SparseEvidence, seed: int) -> Queries:
    """Points 2 to 12 cells behind test hits that no training beam observed.

    `seen` is the `ray_evidence` of the training scans. A point is kept only if its cell and all neighbouring
    cells (8 in 2D, 26 in 3D) have no evidence.
    """
    generator = torch.Generator().manual_seed(seed + 1)
    behind = 2 + 10 * torch.rand(ends.shape[0], generator=generator, dtype=torch.float64)
    direction = (ends - origins) / (ends - origins).norm(dim=1, keepdim=True)
    points = ends + direction * (behind * seen.resolution)[:, None]
    unobserved = torch.ones(points.shape[0], dtype=torch.bool)
    for offset in itertools.product((-1, 0, 1), repeat=points.shape[1]):
        shift = torch.tensor(offset, dtype=torch.float64) * seen.resolution
        hits, misses = seen.at_points(points + shift)
        unobserved &= hits + misses == 0
    kept = points[unobserved]
    return Queries(kept, torch.full((kept.shape[0],), UNKNOWN))


def save_queries(
    path: str | Path, by_resolution: dict[float, Queries], train: Sequence[int], test: Sequence[int]
) -> None:
    """Write the test points as NPZ: points, labels, resolution, train_scans, test_scans.

    `resolution` (M,) is the resolution at which a point is queried; 0 if the points are the same at all
    resolutions.
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
