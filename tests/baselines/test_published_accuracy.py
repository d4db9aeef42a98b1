"""Baselines on the real scans of their papers: the AUC at 0.1 m of held-out scans."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.experiments.baselines import BayesianHilbertMap, BGKMap, HilbertMap, OccupancyGrid
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.occupancy.protocol import BaselineMap
from gmmtorch.scan import Scan

pytestmark = pytest.mark.real_data


def auc(made: BaselineMap, scans: Sequence[Scan], test_every: int) -> float:
    """Of a map of the other scans."""
    train, test = queries.split_indices(len(scans), test_every)
    tested = queries.hit_and_free(*queries.test_beams([scans[i] for i in test], 4000, 0), "uniform", 0.1, 0)
    for i in train:
        made.insert(scans[i])
    theta = torch.as_tensor(made.occupancy(tested.points))
    return metrics.roc(theta[tested.of(1)], theta[tested.of(0)]).auc


@pytest.mark.parametrize("world", ["sim_structured", "sim_unstructured"])
def test_bgk_map_is_more_accurate_than_a_grid_on_its_authors_data(real_data, world):
    """Doherty et al. 2017, Figure 4: it predicts between the beams of sparse scans."""
    scans = list(load("pcd_viewpoint", real_data / "la3dm" / world, max_range=8.0, no_return_range=8.0))
    assert auc(BGKMap(0.1), scans, 4) > auc(OccupancyGrid(0.1), scans, 4) + 0.02


@pytest.mark.slow
@pytest.mark.parametrize(
    ("made", "least"),
    [
        (BayesianHilbertMap(), 0.95),  # published: 0.950
        (HilbertMap("nystroem", epochs=1, free_spacing=3.0, n_features=1500), 0.92),  # published: 0.926
        (HilbertMap("sparse", epochs=1, free_spacing=3.0), 0.965),
    ],
    ids=["bayesian", "nystroem", "sparse"],
)
def test_hilbert_maps_reach_the_published_auc_on_intel(real_data, made, least):
    scans = list(load("carmen", real_data / "laser2d" / "intel.log.gz", stride=2))
    assert auc(made, scans, 10) > least
