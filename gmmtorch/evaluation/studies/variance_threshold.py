"""Effect of the dead band's variance threshold (3.10) on thin structures (thesis Fig 3.8)."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.evaluation import metrics, queries
from gmmtorch.evaluation.events import Event, OnRows, Row, ignore
from gmmtorch.evaluation.queries import FREE, OCCUPIED
from gmmtorch.evaluation.studies.study_options import VarianceThresholdStudy
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.occupancy.evidence import CellClass, classify
from gmmtorch.scan import Scan

_CHUNK = 2048  # points whose neighbours are in memory together


@dataclass
class Thresholds:
    """Rows of results.json, maps by number of components, and the test hits (H, D); `thin` (P, D) are the
    hits on thin structures."""

    rows: list[Row] = field(default_factory=list)
    maps: dict[int, GaussianMap] = field(default_factory=dict)
    hits: Tensor = field(default_factory=lambda: torch.empty(0, 3))
    thin: Tensor = field(default_factory=lambda: torch.empty(0, 3))


def run(
    name: str,
    scans: Sequence[Scan],
    new_map: Callable[[int], GaussianMap],
    study: VarianceThresholdStudy,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> Thresholds:
    """A map for each number of components, and a row for each map and threshold.

    Fields over the held-out points: `share_decided`, the share that is not unknown; `accuracy_decided`, the
    accuracy on that share; `occupied_recall`, `free_recall`; `thin_recall`, the recall of hits on thin
    structures, which are `thin_share` of all hits.
    """
    train_index, test_index = queries.split_indices(len(scans), study.test_every)
    origins, ends = queries.test_beams([scans[i] for i in test_index], study.max_beams, seed)
    asked = queries.hit_and_free(origins, ends, "uniform", study.resolution, seed)
    thin = on_lines(ends, study.thin_radius)
    found = Thresholds(hits=ends, thin=ends[thin])
    on_event("maps", 0, len(study.n_components))
    for n_components in study.n_components:
        built = new_map(n_components)
        begin = time.perf_counter()
        for i in train_index:
            built.insert(scans[i])
        built.finish()
        seconds = time.perf_counter() - begin
        found.maps[n_components] = built
        theta = torch.as_tensor(built.occupancy(asked.points, study.resolution, study.method)).cpu()
        occupied, free = theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]
        shared = {
            "dataset": name,
            "method": study.method,
            "resolution": study.resolution,
            "auc": metrics.roc(occupied, free).auc,
            "auc_thin": metrics.roc(occupied[thin], free).auc if bool(thin.any()) else None,
            "thin_share": float(thin.double().mean()),
            "n_components": built.n_components,
            "nbytes": built.nbytes,
            "build_seconds": seconds,
        }
        for threshold in study.variance_threshold:
            scores = decided(occupied, free, thin, threshold)
            found.rows.append({**shared, "variance_threshold": threshold, **scores})
        on_rows(found.rows)
        on_event("maps", len(found.maps), len(study.n_components))
    return found


def decided(occupied: Tensor, free: Tensor, thin: Tensor, threshold: float) -> Row:
    """Scores of the classification by a threshold, given probabilities of occupied (P,) and free (Q,) points.

    `thin` (P,) marks the occupied points on thin structures.
    """
    of_occupied, of_free = classify(occupied, threshold), classify(free, threshold)
    right = torch.cat([of_occupied == CellClass.OCCUPIED, of_free == CellClass.FREE]).double()
    known = torch.cat([of_occupied, of_free]) != CellClass.UNKNOWN
    found = (of_occupied == CellClass.OCCUPIED).double()
    return {
        "share_decided": float(known.double().mean()),
        "accuracy_decided": float(right[known].mean()) if bool(known.any()) else None,
        "occupied_recall": float(found.mean()),
        "thin_recall": float(found[thin].mean()) if bool(thin.any()) else None,
        "free_recall": float((of_free == CellClass.FREE).double().mean()),
    }


def on_lines(points: Tensor, radius: float, linearity: float = 0.8, fewest: int = 8) -> Tensor:
    """Mask (N,) of the points (N, D) on thin structures: rails, poles, edges of narrow boards.

    Such a point has at least `fewest` neighbours within `radius` (m), and they form a line: (σ₁ − σ₂)/σ₁ is
    above `linearity`, with σ₁ ≥ σ₂ the standard deviations of the neighbours (Demantké et al. 2011).
    """
    tree = cKDTree(points.cpu().numpy())
    parts = [_on_lines(tree, part, points, radius, linearity, fewest) for part in points.split(_CHUNK)]
    return torch.cat(parts) if parts else torch.zeros(0, dtype=torch.bool)


def _on_lines(
    tree: cKDTree, part: Tensor, points: Tensor, radius: float, linearity: float, fewest: int
) -> Tensor:
    neighbours = tree.query_ball_point(part.cpu().numpy(), radius)
    count = torch.tensor([len(n) for n in neighbours])
    owner = torch.repeat_interleave(count)
    flat = torch.tensor(list(itertools.chain.from_iterable(neighbours)), dtype=torch.int64)
    difference = points[flat] - part[owner]
    weight = count.clamp_min(1).double()[:, None]
    n, dim = part.shape
    mean = part.new_zeros(n, dim).index_add_(0, owner, difference) / weight
    outer = (difference[:, :, None] * difference[:, None]).flatten(1)
    second = part.new_zeros(n, dim * dim).index_add_(0, owner, outer) / weight
    spread = second.view(-1, dim, dim) - mean[:, :, None] * mean[:, None]
    deviation = torch.linalg.eigvalsh(spread).clamp_min(0).sqrt().flip(1)
    line = (deviation[:, 0] - deviation[:, 1]) / deviation[:, 0].clamp_min(1e-12)
    return (line > linearity) & (count >= fewest)
