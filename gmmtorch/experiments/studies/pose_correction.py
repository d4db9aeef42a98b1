"""Accuracy of a map whose poses are corrected after it was built.

A grid from wrong poses must be built again. In a map that is learned scan by scan (`map=per_scan`) each
component belongs to one scan, so it moves with the corrected pose of that scan.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.events import Event, OnRows, Row, ignore
from gmmtorch.experiments.evaluation import (
    Protocol,
    Queries,
    hit_and_free,
    keep_share,
    pose_perturbations,
    roc,
    split_indices,
    test_beams,
)
from gmmtorch.mapping import GaussianMap
from gmmtorch.pose import Pose
from gmmtorch.scan import Scan


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
    if len(ids) != len(motions):
        raise InvalidArgumentError(
            f"motions has {len(motions)} entries for {len(ids)} scans; give one for each scan."
        )
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
        on_event: progress callback.
        on_rows: called with all rows so far after new rows.

    Returns a row for each share kept, method and resolution: `dataset, method, removal, kept, resolution,
    pose_noise_m, pose_noise_rad, n_components, nbytes`, and the AUCs `auc` (map from the perturbed poses),
    `auc_corrected` (the same map after correction) and `auc_clean` (map from the true poses).
    """
    train_index, test_index = split_indices(len(scans), protocol.test_every)
    train = [scans[i] for i in train_index]
    origins, ends = test_beams([scans[i] for i in test_index], protocol.max_beams, seed)
    asked = {r: hit_and_free(origins, ends, protocol.free, r, seed) for r in protocol.resolution}
    rows: list[Row] = []
    for kept in protocol.kept:
        on_event("pose correction", 0, 3)
        shown = keep_share(train, kept, protocol.removal, seed)
        motions = pose_perturbations(shown, protocol.pose_noise, seed)
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
            found[method, resolution] = roc(*ask.split(theta)).auc
    return found
