"""Poses that were wrong when a map was built, and are put right afterwards: the components move.

A grid built from wrong poses must be built again. A mixture that was learned scan by scan
(`map=per_scan`) moves with its poses: each scan's components are those with the ids it was given.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation import metrics, queries, split
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.evaluation.held_out import Protocol
from gmmtorch.evaluation.queries import FREE, OCCUPIED, Queries
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.scan import Scan


def build_by_scan(empty: GaussianMap, scans: Sequence[Scan]) -> list[Tensor]:
    """Insert the scans; returns the ids (J, 2) of the components that each became.

    Raises `InvalidArgumentError` for a map whose components are of several scans (window above 1).
    """
    if empty.learning.window != 1:
        raise InvalidArgumentError(
            f"window={empty.learning.window}: a scan's pose can be put right only where components are of "
            "one scan; take map=per_scan."
        )
    born = []
    for scan in scans:
        known = empty.n_components
        empty.insert(scan)
        born.append(empty.components().ids[known:].clone())
    return born


def correct_poses(built: GaussianMap, born: Sequence[Tensor], motions: Sequence[Tensor]) -> None:
    """Undo, in place, the motion (D+1, D+1) that each scan was moved by before it was inserted.

    `born`: the ids (J, 2) of each scan's components, as `build_by_scan` returns them.
    """
    if len(born) != len(motions):
        raise InvalidArgumentError(f"{len(motions)} motions for {len(born)} scans; one each is needed.")
    for ids, motion in zip(born, motions, strict=True):
        if len(ids):
            built.transform(_inverse(motion), ids)


def _inverse(motion: Tensor) -> Tensor:
    """Of a rigid motion, and rigid itself to the last digit."""
    inverse = torch.eye(len(motion), dtype=torch.float64, device=motion.device)
    inverse[:-1, :-1] = motion[:-1, :-1].T
    inverse[:-1, -1] = -motion[:-1, :-1].T @ motion[:-1, -1]
    return inverse


def evaluate_correction(
    name: str,
    scans: Sequence[Scan],
    new_map: Callable[[], GaussianMap],
    protocol: Protocol,
    methods: Sequence[str] = ("point",),
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: Callable[[list[dict[str, Any]]], object] = lambda rows: None,
) -> list[dict[str, Any]]:
    """The test of `evaluation.occupancy`, of maps learned from perturbed poses, before and after correction.

    Args:
        name: of the data set, for the rows.
        scans: in the order they were taken.
        new_map: makes an empty map with window 1.
        protocol: the test; its `pose_noise` (m, rad) perturbs the training poses.
        methods: forms of evidence that the maps are asked for.
        seed: of the perturbations, the thinning and the free points.
        on_event: told of progress.
        on_rows: given all rows so far, whenever there are more.

    Returns a row for each share kept, method and resolution: `dataset, method, removal, kept,
    resolution, pose_noise_m, pose_noise_rad, n_components, nbytes`, and the areas `auc` (of the map as it was
    learned from the wrong poses), `auc_corrected` and `auc_clean` (of one learned from right ones).
    """
    train_index, test_index = split.split_indices(len(scans), protocol.test_every)
    train = [scans[i] for i in train_index]
    origins, ends = queries.test_beams([scans[i] for i in test_index], protocol.max_beams, seed)
    asked = {r: queries.hit_and_free(origins, ends, protocol.free, r, seed) for r in protocol.resolution}
    rows = []
    for kept in protocol.kept:
        on_event("pose correction", 0, 3)
        shown = split.keep_share(train, kept, protocol.removal, seed)
        motions = split.pose_perturbations(shown, protocol.pose_noise, seed)
        moved = [scan.transformed(motion) for scan, motion in zip(shown, motions, strict=True)]
        right, wrong = new_map(), new_map()
        build_by_scan(right, shown)
        on_event("pose correction", 1, 3)
        born = build_by_scan(wrong, moved)
        n_components, nbytes = wrong.n_components, wrong.nbytes
        cases = [(method, resolution) for method in methods for resolution in protocol.resolution]
        clean, before = (
            {case: _auc(built, *case, asked[case[1]]) for case in cases} for built in (right, wrong)
        )
        on_event("pose correction", 2, 3)
        correct_poses(wrong, born, motions)
        for method, resolution in cases:
            rows.append(
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
                    "auc_corrected": _auc(wrong, method, resolution, asked[resolution]),
                    "auc_clean": clean[method, resolution],
                }
            )
        on_rows(rows)
        on_event("pose correction", 3, 3)
    return rows


def _auc(built: GaussianMap, method: str, resolution: float, asked: Queries) -> float:
    theta = torch.as_tensor(built.occupancy(asked.points, resolution, method)).cpu()
    return metrics.roc(theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]).auc
