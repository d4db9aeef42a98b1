"""Maps that differ in options of learning, on one test: components, bytes, AUC, held-out likelihood.

`experiment=pruning` compares pruning, trees and components of free space (thesis 2.1.2, 2.1.4, 3.5) with the
map that has none of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from gmmtorch.events import Event, OnRows, Row, ignore
from gmmtorch.experiments.evaluation import Built, Form, Protocol, auc_gain, evaluate, split_indices
from gmmtorch.mapping import GaussianMap
from gmmtorch.mixture import GaussianMixture
from gmmtorch.scan import Scan

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
        outcome = evaluate(name, scans, {variant: factory}, protocol, seed, on_event)
        for built in outcome.shown:
            assert isinstance(built.map, GaussianMap)
            base = first.setdefault(built.row["resolution"], built)
            gain = auc_gain(base.asked.split(base.theta), built.asked.split(built.theta))
            rows.append(
                {
                    **built.row,
                    "variant": variant,
                    "n_free_components": int(built.map.max_range.sum()),
                    "auc_gain": gain.mean,
                    "auc_gain_low": gain.low,
                    "auc_gain_high": gain.high,
                    "held_out_log_likelihood": surface_score(built.map, ends),
                }
            )
        on_rows(rows)
    return rows


def held_out_points(scans: Sequence[Scan], test_every: int) -> Tensor:
    """About 5000 points (N, D) of the held-out scans."""
    points = torch.cat([scans[i].points for i in split_indices(len(scans), test_every)[1]])
    return points[:: max(1, len(points) // _SCORED_POINTS)].double()


def surface_score(built: GaussianMap, points: Tensor) -> float:
    """Mean log-likelihood (nats) of points (N, D) under the surfaces of a map, before the codec rounds them,
    weighted by their support.
    """
    hits = ~built.max_range
    weight, means, covariances = built.support[hits], built.means[hits], built.covariances[hits]
    return GaussianMixture.from_parameters(weight / weight.sum(), means, covariances).score(points)
