"""Studies of maps: AUC against size, options of learning, and corrected poses.

- AUC against map size in bytes (thesis Table 3.1): every method at several sizes, on one test.
- Maps that differ in options of learning, on one test: `experiment=pruning` compares pruning, trees and
  components of free space (thesis 2.1.2, 2.1.4, 3.5) with the map that has none of them.
- Maps whose poses are corrected after they were built. A grid from wrong poses must be built again. In a map
  that is learned scan by scan (`map=per_scan`) each component moves with the corrected pose of its scan.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments import evaluation
from gmmtorch.experiments.evaluation import Built, Form, MapFactory, Protocol, Queries
from gmmtorch.mapping import GaussianMap
from gmmtorch.mixture import GaussianMixture
from gmmtorch.occupancy import OccupancyMap
from gmmtorch.pose import Pose
from gmmtorch.report import Event, OnRows, Row, ignore
from gmmtorch.scan import Scan


def run_auc_memory(
    name: str,
    scans: Sequence[Scan],
    methods: Mapping[tuple[str, int | None], MapFactory],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """A row of `held_out.evaluate` for each method, with the field `size`.

    methods: by their names and sizes: numbers of components or stored points; None of a method with one size.
    """
    names = {name if size is None else f"{name} {size}": (name, size) for name, size in methods}

    def with_size(rows: Sequence[Row]) -> list[Row]:
        sized = [names[row["method"]] for row in rows]
        return [{**row, "method": m, "size": n} for row, (m, n) in zip(rows, sized, strict=True)]

    factories = dict(zip(names, methods.values(), strict=True))
    outcome = evaluation.evaluate(
        name, scans, factories, protocol, seed, on_event, lambda rows: on_rows(with_size(rows))
    )
    return with_size(outcome.rows)


_SCORED_POINTS = 5000


def run_map_variants(
    name: str,
    scans: Sequence[Scan],
    variants: Mapping[str, Form],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """A row of `held_out.evaluate` for each variant, with the largest share of the data that is kept.

    Further fields: `variant`; `n_free_components`, of no-return beams and free points; `auc_gain`,
    `auc_gain_low`, `auc_gain_high`: the AUC minus that of the first variant, with its 95 % interval;
    `held_out_log_likelihood`, of held-out returns under the components of surfaces, nats per point.
    """
    ends = held_out_points(scans, protocol.test_every)
    rows: list[Row] = []
    first: dict[float, Built] = {}
    for variant, factory in variants.items():
        outcome = evaluation.evaluate(name, scans, {variant: factory}, protocol, seed, on_event)
        for built in outcome.shown:
            assert isinstance(built.map, GaussianMap)
            base = first.setdefault(built.row["resolution"], built)
            gain, low, high = evaluation.auc_gain(
                base.asked.split(base.theta), built.asked.split(built.theta)
            )
            rows.append(
                {
                    **built.row,
                    "variant": variant,
                    "n_free_components": int(built.map.max_range.sum()),
                    "auc_gain": gain,
                    "auc_gain_low": low,
                    "auc_gain_high": high,
                    "held_out_log_likelihood": surface_score(built.map, ends),
                }
            )
        on_rows(rows)
    return rows


def held_out_points(scans: Sequence[Scan], test_every: int) -> Tensor:
    """About 5000 points (N, D) of the held-out scans."""
    points = torch.cat([scans[i].points for i in evaluation.split_indices(len(scans), test_every)[1]])
    return points[:: max(1, len(points) // _SCORED_POINTS)].double()


def surface_score(built: OccupancyMap, points: Tensor) -> float:
    """Mean log-likelihood (nats) of points (N, D) under the surfaces of a `GaussianMap`, before the codec
    rounds them, weighted by their support.
    """
    assert isinstance(built, GaussianMap)
    hits = ~built.max_range
    weight, means, covariances = built.support[hits], built.means[hits], built.covariances[hits]
    return GaussianMixture.from_parameters(weight / weight.sum(), means, covariances).score(points)


def build_by_scan(empty: GaussianMap, scans: Sequence[Scan]) -> list[Tensor]:
    """Insert the scans; returns the ids (J, 2) of each scan's components.

    Raises `InvalidArgumentError` for a map that learns several scans together (window above 1).
    """
    if empty.learning.window != 1:
        raise InvalidArgumentError(
            f"window={empty.learning.window}: the pose of a scan can be corrected only if each component "
            "belongs to one scan; take map=per_scan."
        )
    ids = []
    for scan in scans:
        n_before = empty.n_components
        empty.insert(scan)
        ids.append(empty.components().ids[n_before:].clone())
    return ids


def correct_poses(built: GaussianMap, ids: Sequence[Tensor], motions: Sequence[Tensor]) -> None:
    """Undo, in place, the motion (D+1, D+1) that was applied to each scan before its insertion.

    `ids`: the ids (J, 2) of each scan's components, from `build_by_scan`.
    """
    for ids_of_scan, motion in zip(ids, motions, strict=True):
        if len(ids_of_scan):
            built.transform(Pose.from_matrix(motion).inverse().matrix, ids_of_scan)


def evaluate_correction(
    name: str,
    scans: Sequence[Scan],
    new_map: Callable[[], GaussianMap],
    protocol: Protocol,
    methods: Sequence[str] = ("point",),
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """The test of `held_out` for maps from perturbed poses, before and after the correction.

    Args:
        name: of the data set, for the rows.
        scans: in time order.
        new_map: makes an empty map with window 1.
        protocol: the test; its `pose_noise` (m, rad) perturbs the training poses.
        methods: forms of evidence.
        seed: of the perturbations, the random choice of training data, and the free points.

    Returns a row for each share kept, method and resolution, with the AUCs `auc` (map from the perturbed
    poses), `auc_corrected` (the same map after correction) and `auc_clean` (map from the true poses).
    """
    train_index, test_index = evaluation.split_indices(len(scans), protocol.test_every)
    train = [scans[i] for i in train_index]
    origins, ends = evaluation.test_beams([scans[i] for i in test_index], protocol.max_beams, seed)
    asked = {r: evaluation.hit_and_free(origins, ends, protocol.free, r, seed) for r in protocol.resolution}
    rows: list[Row] = []
    for kept in protocol.kept:
        on_event("pose correction", 0, 3)
        shown = evaluation.keep_share(train, kept, protocol.removal, seed)
        motions = evaluation.pose_perturbations(shown, protocol.pose_noise, seed)
        moved = [scan.transformed(motion) for scan, motion in zip(shown, motions, strict=True)]
        true_map, perturbed_map = new_map(), new_map()
        build_by_scan(true_map, shown)
        on_event("pose correction", 1, 3)
        ids = build_by_scan(perturbed_map, moved)
        n_components, nbytes = perturbed_map.n_components, perturbed_map.nbytes
        clean, before = (_aucs(built, methods, asked) for built in (true_map, perturbed_map))
        on_event("pose correction", 2, 3)
        correct_poses(perturbed_map, ids, motions)
        rows += [
            {
                "dataset": name,
                "method": method,
                "removal": protocol.removal,
                "kept": float(kept),
                "resolution": float(resolution),
                "pose_noise_m": float(protocol.pose_noise[0]),
                "pose_noise_rad": float(protocol.pose_noise[1]),
                "n_components": n_components,
                "nbytes": nbytes,
                "auc": before[method, resolution],
                "auc_corrected": after,
                "auc_clean": clean[method, resolution],
            }
            for (method, resolution), after in _aucs(perturbed_map, methods, asked).items()
        ]
        on_rows(rows)
        on_event("pose correction", 3, 3)
    return rows


def _aucs(
    built: GaussianMap, methods: Sequence[str], asked: dict[float, Queries]
) -> dict[tuple[str, float], float]:
    """The AUC of a map for each method and resolution."""
    found = {}
    for method in methods:
        for resolution, ask in asked.items():
            theta = torch.as_tensor(built.occupancy(ask.points, resolution, method)).cpu()
            found[method, resolution] = evaluation.roc(*ask.split(theta)).auc
    return found
