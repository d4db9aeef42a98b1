"""What decides whether thin structures are found by the variance threshold (3.10): thesis Fig 3.8.

Without a data set, a simulated railing in front of a wall is scanned, whose truth is known.
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.experiments.evaluation import FREE, OCCUPIED, hit_and_free, roc, split_indices, test_beams
from gmmtorch.experiments.studies.study_options import COUNTS, VarianceThresholdStudy
from gmmtorch.mapping import GaussianMap, Query
from gmmtorch.occupancy import Calibration, CellClass, PointEvidence, SparseEvidence, classify, probability
from gmmtorch.report import Event, OnRows, Row, ignore
from gmmtorch.scan import Scan
from gmmtorch.simulation import MeshWorld, box, sense, spinning_lidar

_HALF, _HEIGHT = 3.0, 1.1  # half the length and the height (m) of the railing, which lies in the plane y = 0
_POSTS = (-3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)
_BARS = (0.55, _HEIGHT)
_NOISE = 0.01
_FLOOR = 0.15  # points below belong to the floor (m)

BOUNDS: tuple[tuple[float, ...], tuple[float, ...]] = ((-0.3, -0.5, _FLOOR), (3.3, 0.5, 1.35))
"""Lowest and highest corner (m) of a box around one half of the railing, without the floor."""


def railing_world(width: float) -> MeshWorld:
    """Posts and two bars of square section, `width` metres wide, 3 m before a wall, on a floor."""
    half = 0.5 * width
    parts = [
        box((-8.0, -8.0, -0.1), (8.0, 3.1, 0.0)),
        box((-8.0, 3.0, 0.0), (8.0, 3.1, 3.0)),
        *(box((x - half, -half, 0.0), (x + half, half, _HEIGHT)) for x in _POSTS),
        *(box((-_HALF, -half, z - half), (_HALF, half, z + half)) for z in _BARS),
    ]
    return MeshWorld(torch.cat(parts))


def railing_scans(width: float, n_scans: int, seed: int) -> list[Scan]:
    """Scans (32 × 480 beams, range 12 m, noise 1 cm) from places along the railing, 4 m before it."""
    sensor = spinning_lidar(32, 480, (-math.radians(20), math.radians(12)), 12.0, _NOISE)
    world, generator = railing_world(width), torch.Generator().manual_seed(seed)
    found = []
    for x in torch.linspace(-4, 4, n_scans, dtype=torch.float64):
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, 3] = torch.stack([x, torch.tensor(-4.0).double(), torch.tensor(1.2).double()])
        ends, missed = sense(sensor, pose, world, generator)
        found.append(Scan(ends[~missed], pose[:3, 3], ends[missed]))
    return found


def is_of_railing(scan: Scan, width: float) -> Tensor:
    """Mask (N,) of the points of a scan that the railing returned."""
    x, y, z = scan.points.unbind(1)
    reach = 0.5 * width + 5 * _NOISE
    return (y.abs() < reach) & (x.abs() < _HALF + reach) & (z > _FLOOR) & (z < _HEIGHT + reach)


_BEHIND = 0.5  # a beam passes a structure if it ends this far behind (m)
_SIDES = 4  # axes across a beam along which a structure may be narrow


class Thresholds(NamedTuple):
    """Rows of results.json, and evidence by number of components (None: the rays themselves).

    hits (H, D): test hits; thin (P, D): those on thin structures.
    """

    rows: list[Row]
    sources: dict[int | None, Source]
    hits: Tensor
    thin: Tensor


class Source(NamedTuple):
    """Evidence at points, from a map or from the rays themselves.

    evidence: (points (M, D), resolution (m), method) → hits and misses. calibration: of the map; of the
    sensor model, for rays.
    """

    evidence: Callable[[Tensor, float, str], PointEvidence]
    calibration: Calibration
    facts: Row

    def occupancy(self, found: PointEvidence, resolution: float, dim: int, prior: float | None) -> Tensor:
        """Probabilities (M,) that follow from evidence: from counts with a prior, or calibrated (None)."""
        rule = self.calibration if prior is None else prior
        return probability(found.hits, found.misses, resolution, dim, rule).cpu()


def run_variance_threshold(
    name: str,
    scans: Sequence[Scan],
    new_map: Callable[[int], GaussianMap],
    study: VarianceThresholdStudy,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
    is_thin: Callable[[Scan], Tensor] | None = None,
) -> Thresholds:
    """A row for each number of components, form, cell, prior and threshold.

    Method "counts" needs no map: it counts the training rays in cells. Fields over held-out points: see
    `decided`, `auc`, `auc_thin`, `brier`. `thin_share`: share of the hits that lie on thin structures, by
    `is_thin` (default: `seen_past` with `study.thin_width`).
    """
    train_index, test_index = split_indices(len(scans), study.test_every)
    train, test = [scans[i] for i in train_index], [scans[i] for i in test_index]
    origins, ends = test_beams(test, study.max_beams, seed)
    asked = hit_and_free(origins, ends, "uniform", 0.0, seed)
    thin = [s.points[(is_thin or (lambda one: seen_past(one, study.thin_width)))(s)].double() for s in test]
    on_thin = torch.cat(thin).cpu()
    share = len(on_thin) / sum(len(scan.points) for scan in test)
    generator = torch.Generator().manual_seed(seed)
    on_thin = on_thin[torch.randperm(len(on_thin), generator=generator)[: study.max_beams]]
    found = Thresholds([], {}, ends, on_thin)
    points = torch.cat([asked.points, on_thin])
    labels = torch.cat([asked.labels, torch.full((len(on_thin),), OCCUPIED)])
    on_event("maps", 0, len(study.n_components) + 1)
    for n_components, source in _sources(train, new_map, study):
        found.sources[n_components] = source
        methods = [name for name in study.method if (name == COUNTS) == (n_components is None)]
        for method, resolution in itertools.product(methods, study.resolution):
            evidence = source.evidence(points, resolution, method)
            shared = {"dataset": name, "method": method, "resolution": resolution, "thin_share": share}
            thetas = {p: source.occupancy(evidence, resolution, points.shape[1], p) for p in study.prior}
            found.rows.extend(_rows({**shared, **source.facts}, thetas, labels, len(asked.points), study))
        on_rows(found.rows)
        on_event("maps", len(found.sources), len(study.n_components) + 1)
    return found


def _sources(
    train: Sequence[Scan], new_map: Callable[[int], GaussianMap], study: VarianceThresholdStudy
) -> Iterator[tuple[int | None, Source]]:
    """The rays themselves, and a map for each number of components."""
    yield None, _counted(train)
    if all(method == COUNTS for method in study.method):
        return
    for n_components in study.n_components:
        built = new_map(n_components)
        begin = time.perf_counter()
        for scan in train:
            built.insert(scan)
        built.finish()
        seconds = time.perf_counter() - begin
        query = Query([built.components()], replace(built.query_options, prior=None))
        facts = {"n_components": built.n_components, "nbytes": built.nbytes, "build_seconds": seconds}
        assert isinstance(query.rule, Calibration)  # without a prior
        yield n_components, Source(query.evidence_at, query.rule, facts)


def _counted(train: Sequence[Scan]) -> Source:
    """The rays of scans, counted in the cells that they cross."""
    lattices: dict[float, SparseEvidence] = {}

    def evidence(points: Tensor, resolution: float, method: str) -> PointEvidence:
        if resolution not in lattices:
            lattices[resolution] = SparseEvidence(resolution, points.shape[1])
            for scan in train:
                ends = torch.cat([scan.points, scan.no_return]).double().cpu()
                is_hit = torch.arange(len(ends)) < len(scan.points)
                lattices[resolution].add_rays(scan.origin.double().cpu().expand_as(ends), ends, None, is_hit)
        return PointEvidence(*lattices[resolution].at_points(points))

    ranges = torch.cat([(scan.points - scan.origin).norm(dim=1).double().cpu() for scan in train])
    return Source(
        evidence,
        Calibration.prior(float(ranges.mean())),
        {"n_components": None, "nbytes": None, "build_seconds": 0.0},
    )


def cells_by_setting(
    found: Thresholds, study: VarianceThresholdStudy
) -> dict[int, Callable[[Tensor], dict[str, Tensor]]]:
    """For each number of components: centres (M, D) of cells → masks (M,) of the cells to draw, by a title.

    Cells have the first side and prior of the study. At its lowest threshold, from counts: the occupied
    cells, and those with a hit that are not free; calibrated: the latter, and the cells that are occupied at
    the highest threshold.
    """
    methods = [name for name in study.method if name != COUNTS]
    resolution, prior = study.resolution[0], study.prior[0]
    strict, lenient = min(study.variance_threshold), max(study.variance_threshold)

    def masks_of(source: Source) -> Callable[[Tensor], dict[str, Tensor]]:
        def masks(centers: Tensor) -> dict[str, Tensor]:
            evidence = source.evidence(centers, resolution, methods[-1])
            hit = evidence.hits.cpu() >= 0.5
            counts, known = (
                source.occupancy(evidence, resolution, centers.shape[1], x) for x in (prior, None)
            )
            by_counts, by_known = classify(counts, strict), classify(known, strict)
            return {
                f"counts, v = {strict:g}:\noccupied": by_counts == CellClass.OCCUPIED,
                f"counts, v = {strict:g}:\nhit and not free": hit & (by_counts != CellClass.FREE),
                f"calibrated, v = {strict:g}:\nhit and not free": hit & (by_known != CellClass.FREE),
                f"calibrated, v = {lenient:g}:\noccupied": classify(known, lenient) == CellClass.OCCUPIED,
            }

        return masks

    return {n: masks_of(source) for n, source in found.sources.items() if n is not None}


def _rows(
    shared: Row,
    thetas: dict[float | None, Tensor],
    labels: Tensor,
    n_asked: int,
    study: VarianceThresholdStudy,
) -> list[Row]:
    """A row for each prior and threshold; points after the first `n_asked` are thin."""
    rows = []
    for prior, theta in thetas.items():
        asked, thin, truth = theta[:n_asked], theta[n_asked:], labels[:n_asked]
        occupied, free = asked[truth == OCCUPIED], asked[truth == FREE]
        scores = {
            "auc": roc(occupied, free).auc,
            "auc_thin": roc(thin, free).auc if len(thin) else None,
            "brier": float((asked - (truth == OCCUPIED).double()).square().mean()),
        }
        for threshold in study.variance_threshold:
            setting = {"prior": prior, "variance_threshold": threshold}
            rows.append({**shared, **setting, **scores, **decided(occupied, free, thin, threshold)})
    return rows


def decided(occupied: Tensor, free: Tensor, thin: Tensor, threshold: float) -> Row:
    """Scores of the classification by a threshold, given probabilities of occupied (P,), free (Q,) and thin
    (T,) points.

    `share_decided`: points that are not unknown; `accuracy_decided`: accuracy on these. `occupied_recall`,
    `thin_recall`, `free_recall`: points of the right class. `thin_kept`: thin points that are not called
    free, and `free_occupied`: free points that are called occupied.
    """
    of_occupied, of_free, of_thin = (classify(theta, threshold) for theta in (occupied, free, thin))
    right = torch.cat([of_occupied == CellClass.OCCUPIED, of_free == CellClass.FREE])
    known = torch.cat([of_occupied, of_free]) != CellClass.UNKNOWN
    return {
        "share_decided": _share(known),
        "accuracy_decided": _share(right[known]),
        "occupied_recall": _share(of_occupied == CellClass.OCCUPIED),
        "thin_recall": _share(of_thin == CellClass.OCCUPIED),
        "thin_kept": _share(of_thin != CellClass.FREE),
        "free_recall": _share(of_free == CellClass.FREE),
        "free_occupied": _share(of_free == CellClass.OCCUPIED),
    }


def _share(mask: Tensor) -> float | None:
    return float(mask.double().mean()) if len(mask) else None


def seen_past(scan: Scan, width: float) -> Tensor:
    """Mask (N,) of the points of a scan on structures narrower than about `width` (m): rails, poles, cables.

    Beams of the same scan pass such a point on two opposite sides: at `width`/2 across its beam, to within
    `width`/3, they end at least 0.5 m behind it or have no return. Edges of surfaces are passed on one side.
    """
    points, ends = scan.points.double().cpu(), torch.cat([scan.points, scan.no_return]).double().cpu()
    origin = scan.origin.double().cpu()
    if len(points) == 0:
        return torch.zeros(0, dtype=torch.bool)
    distance = (ends - origin).norm(dim=1)
    tree = cKDTree(((ends - origin) / distance[:, None]).numpy())
    reach, own = points - origin, distance[: len(points)]
    distance[len(points) :] = torch.inf  # beams without a return pass everything
    thin = torch.zeros(len(points), dtype=torch.bool)
    for axis in _across(reach / own[:, None]):
        passed = torch.ones_like(thin)
        for side in (-0.5 * width * axis, 0.5 * width * axis):
            toward = torch.nn.functional.normalize(reach + side, dim=1)
            gap, beam = (torch.from_numpy(found) for found in tree.query(toward.numpy()))
            passed &= (gap * own < width / 3) & (distance[beam] > own + _BEHIND)
        thin |= passed
    return thin


def _across(direction: Tensor) -> list[Tensor]:
    """Unit vectors (N, D) perpendicular to unit vectors (N, D): one in 2D, `_SIDES` in 3D."""
    if direction.shape[1] == 2:
        return [torch.stack([-direction[:, 1], direction[:, 0]], 1)]
    pole = torch.eye(3, dtype=direction.dtype)[direction.abs().argmin(1)]
    first = torch.nn.functional.normalize(torch.linalg.cross(direction, pole), dim=1)
    second = torch.linalg.cross(direction, first)
    angles = [math.pi * k / _SIDES for k in range(_SIDES)]
    return [math.cos(angle) * first + math.sin(angle) * second for angle in angles]
