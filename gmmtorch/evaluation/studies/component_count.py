"""How many components? What is gained by each, and what rules that find the number by themselves choose.

A cloud is fitted with K components for a range of K: the curve of quality against bytes. On it lie the
points that are chosen by

    flat_pieces    the cloud's pieces that are flat, for the sensor's noise (`mixture.em.partition`)
    bic            the least Bayesian information criterion over the range of K: as dear as the curve
    mean_shift     the modes of a flat-kernel mean shift of the points. (Goel, Michael & Tabib's SOGMM
                   counts those of range and intensity, 2023; a cloud has only positions.)
    hierarchical   the leaves of a tree whose branches end where they are thinner than flat pieces are

All but the last are fitted by the same EM from the same kind of start, flat pieces: what differs is the
number. Then maps of all scans are asked about held-out beams: `map_flat_pieces`, whose windows take
as many components as they ask for, against `map_fixed`, K components a window.
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple, TypeVar

import torch
from sklearn.cluster import MeanShift
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.evaluation import held_out as occupancy
from gmmtorch.evaluation import split
from gmmtorch.evaluation.estimators import FitOptions
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.evaluation.methods import MapFactory
from gmmtorch.evaluation.studies.fitting import Material, OnRows, Row, row_of
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.mixture.em.initialization import surface_pieces
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.trees.hierarchical import HierarchicalGaussianMixture
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.scan import Scan

RULES = ("fixed", "flat_pieces", "bic", "mean_shift", "hierarchical", "map_fixed", "map_flat_pieces")

T = TypeVar("T")

_SCORED_POINTS = 5000  # held out, of which a map's likelihood is the mean


@dataclass(frozen=True)
class CountStudy:
    """What is compared: the options `study.*`.

    n_components: the curve's K; what is more than the training points is left out. noise: standard
    deviation of the range sensor (m). multiples: of the noise, that flat pieces and trees are told.
    bandwidths: of the mean shift, in shares of the cloud's root mean square distance from its mean.
    window: scans that the cloud is of, those in the middle, and scans that a map learns together.
    window_components: K of each window; none: no maps. Those below are for maps, of two scans or more.
    resolution: side (m) of the cells asked about. test_every: scans 0, n, 2n, … are held out.
    max_beams: held-out beams at most. n_samples: rays drawn from a map to answer.
    """

    n_components: Sequence[int] = (16, 32, 64, 128, 256, 512, 1024)
    noise: float = 0.01
    multiples: Sequence[float] = (0.5, 1.0, 2.0, 4.0)
    bandwidths: Sequence[float] = (0.4, 0.2, 0.1)
    window: int = 20
    window_components: Sequence[int] = (25, 50, 100, 200, 400, 800)
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 50_000
    n_samples: int = 1_000_000

    def __post_init__(self) -> None:
        if not self.n_components:
            raise InvalidArgumentError("study.n_components is empty; name at least one.")
        for name in ("n_components", "window_components"):
            for k in getattr(self, name):
                check_whole(f"study.{name}", k, 1)
        for name in ("window", "max_beams", "n_samples"):
            check_whole(f"study.{name}", getattr(self, name), 1)
        for name in ("multiples", "bandwidths"):
            for value in getattr(self, name):
                _check_positive(f"study.{name}", value)
        _check_positive("study.noise", self.noise)
        split.check_test_every(self.test_every)
        check_resolution(self.resolution)


def _check_positive(name: str, value: float) -> None:
    if not 0 < value < math.inf:
        raise InvalidArgumentError(f"{name}={value} must be a finite number above zero.")


def middle(scans: Sequence[Scan], window: int) -> Sequence[Scan]:
    """The `window` scans in the middle, or all there are."""
    first = max(0, (len(scans) - window) // 2)
    return scans[first : first + window]


def run(
    material: Material,
    scans: Sequence[Scan],
    study: CountStudy | None = None,
    options: FitOptions | None = None,
    seed: int = 0,
    on_event: Event = ignore,
    on_rows: OnRows = lambda rows: None,
) -> list[Row]:
    """The curve, the choices on it, and the maps.

    Args:
        material: points of the window that mixtures are learned from and scored on.
        scans: what maps are of, in the order they were taken; fewer than two: no maps.
        study: what is compared.
        options: of EM: `reg_covar`, `tol`, `max_iter`, `algorithm`, `dtype`.
        seed: of PSNR2's points, the free points and the maps' rays.
        on_event: told of progress. on_rows: given the rows so far whenever there is one more.

    Returns rows with the fields of every fit, which are None where they were not measured, and: `rule`;
    `setting`, the K, multiple of the noise or share that the rule was given; `count_seconds`, what
    finding K takes, of all `seconds`; `component_bytes`, four for each number of a component (40 in
    3D, 24 in 2D); `bic` of the training points; `auc`, `auc_low`, `auc_high`.
    """
    study, options = study or CountStudy(), options or FitOptions()
    cases = _cases(material.train, study, options)
    rows: list[Row] = []
    on_event("components", 0, len(cases))
    for rule, setting, learn in cases:
        rows.append(_row(material, rule, setting, learn(), seed))
        on_rows(rows)
        on_event("components", len(rows), len(cases))
    rows.append(_least_bic([row for row in rows if row["rule"] == "fixed"]))
    on_rows(rows)
    if len(scans) > 1 and study.window_components:
        rows += map_rows(material.dataset, scans, study, seed, on_event)
        on_rows(rows)
    return rows


_NO_MAP = {"auc": None, "auc_low": None, "auc_high": None}


class Learned(NamedTuple):
    """A mixture; seconds to find its number of components, and in all."""

    mixture: MixtureEstimator
    count_seconds: float
    seconds: float


def _cases(
    points: Tensor, study: CountStudy, options: FitOptions
) -> list[tuple[str, float, Callable[[], Learned]]]:
    """Every rule with every setting, and how it learns."""
    counts = [k for k in study.n_components if k <= len(points)]
    if not counts:
        raise InvalidArgumentError(
            f"study.n_components={list(study.n_components)}: all are above the number of points, "
            f"{len(points)}."
        )
    noise = study.noise
    return [
        *(("fixed", k, partial(_by_number, points, k, options)) for k in counts),
        *(("flat_pieces", m, partial(_by_surfaces, points, m * noise, options)) for m in study.multiples),
        *(("mean_shift", share, partial(_by_modes, points, share, options)) for share in study.bandwidths),
        *(("hierarchical", m, partial(_by_tree, points, 2 * m * noise, options)) for m in study.multiples),
    ]


def _by_number(points: Tensor, n_components: int, options: FitOptions) -> Learned:
    mixture = GaussianMixture(**{**_em(options), "n_components": n_components})
    return Learned(mixture, 0.0, _fit(mixture, points))


def _by_surfaces(points: Tensor, noise: float, options: FitOptions) -> Learned:
    cloud = points.double() - points.double().mean(0)
    ones = cloud.new_ones(len(cloud))
    _, counting = _timed(lambda: surface_pieces(cloud, ones, noise, options.reg_covar))
    mixture = GaussianMixture(**{**_em(options), "n_components": None, "noise": noise})
    return Learned(mixture, counting, _fit(mixture, points))


def _by_modes(points: Tensor, share: float, options: FitOptions) -> Learned:
    n_components, counting = _timed(lambda: count_modes(points, share))
    learned = _by_number(points, n_components, options)
    return Learned(learned.mixture, counting, counting + learned.seconds)


def _by_tree(points: Tensor, thickness: float, options: FitOptions) -> Learned:
    taken = {name: getattr(options, name) for name in ("tol", "max_iter", "reg_covar", "dtype")}
    tree = HierarchicalGaussianMixture(None, thickness=thickness, random_state=0, **taken)
    return Learned(tree, 0.0, _fit(tree, points))


def _em(options: FitOptions) -> dict[str, Any]:
    """The same EM for all numbers, from flat pieces; nothing in it is random."""
    return {**vars(options), "init_params": "flat_pieces", "n_init": 1, "random_state": 0}


def _fit(mixture: GaussianMixture | HierarchicalGaussianMixture, points: Tensor) -> float:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # whether it converged is in the row
        return _timed(lambda: mixture.fit(points))[1]


def _timed(work: Callable[[], T]) -> tuple[T, float]:
    begin = time.perf_counter()
    result = work()
    return result, time.perf_counter() - begin


def _row(material: Material, rule: str, setting: float, learned: Learned, seed: int) -> Row:
    mixture, counting, seconds = learned
    row = row_of(material, "em", mixture, seconds, seed)
    return {
        **row,
        "rule": rule,
        "setting": float(setting),
        "count_seconds": counting,
        "component_bytes": component_bytes(row["n_components"], material.train.shape[1]),
        "bic": mixture.bic(material.train),
        **_NO_MAP,
    }


def _least_bic(curve: Sequence[Row]) -> Row:
    """The row of the least criterion, for the time of all of them."""
    best = min(curve, key=lambda row: float(row["bic"]))
    seconds = sum(row["seconds"] for row in curve)
    return {**best, "rule": "bic", "seconds": seconds, "count_seconds": seconds - best["seconds"]}


def component_bytes(n_components: int, dim: int) -> int:
    """Four bytes for each number of a component: its weight, mean and covariance; 40 in 3D."""
    return 4 * n_components * (1 + dim + dim * (dim + 1) // 2)


def count_modes(points: Tensor, share: float) -> int:
    """How many modes a flat-kernel mean shift of points (N, D) has.

    Its bandwidth is a share of the points' root mean square distance from their mean.
    """
    cloud = points.double().cpu() - points.double().cpu().mean(0)
    bandwidth = share * float(cloud.square().sum(1).mean().sqrt())
    if bandwidth == 0:
        return 1
    return len(MeanShift(bandwidth=bandwidth, bin_seeding=True).fit(cloud.numpy()).cluster_centers_)


# -- maps -------------------------------------------------------------------------------------------


def map_rows(
    dataset: str, scans: Sequence[Scan], study: CountStudy, seed: int = 0, on_event: Event = ignore
) -> list[Row]:
    """Maps of the training scans, by flat pieces and with fixed numbers of components a window."""
    rule = WindowedRule(noise=study.noise)
    cases = [
        ("map_flat_pieces", multiple, replace(rule, noise=multiple * study.noise))
        for multiple in study.multiples
    ]
    # Of a length of nearly nothing, and of single points: cut until the number is reached.
    endless = replace(rule, length=1e-9, min_points=1.0)
    cases += [("map_fixed", k, replace(endless, n_components=k)) for k in study.window_components]

    def factory(learning: WindowedRule) -> MapFactory:
        return lambda resolution: GaussianMap(
            learning, window=study.window, n_samples=study.n_samples, random_state=seed
        )

    factories = {f"{name} {setting:g}": factory(learning) for name, setting, learning in cases}
    protocol = occupancy.Protocol(study.test_every, resolution=(study.resolution,), max_beams=study.max_beams)
    outcome = occupancy.evaluate(dataset, scans, factories, protocol, seed, on_event)
    test = torch.cat([scans[i].points for i in split.split_indices(len(scans), study.test_every)[1]])
    test = test[:: max(1, len(test) // _SCORED_POINTS)]
    return [
        {
            "dataset": dataset,
            "method": "map",
            "n_points": row["n_train_points"],
            "n_components": row["n_components"],
            "n_components_used": row["n_components"],
            "seconds": row["build_seconds"],
            **dict.fromkeys(_UNMEASURED),
            "held_out_log_likelihood": _density(built.map).score(test),
            "nbytes": row["nbytes"],
            "rule": name,
            "setting": float(setting),
            "count_seconds": None,
            "component_bytes": component_bytes(row["n_components"], test.shape[1]),
            "bic": None,
            **{field: row[field] for field in _NO_MAP},
        }
        for (name, setting, _), row, built in zip(cases, outcome.rows, outcome.shown, strict=True)
    ]


_UNMEASURED = (
    "n_iterations",
    "converged",
    "log_likelihood",
    "psnr2_db",
    "psnr_forward_db",
    "psnr_backward_db",
    "held_out_psnr2_db",
)


def _density(built: object) -> GaussianMixture:
    """The mixture of a map's returns."""
    assert isinstance(built, GaussianMap)
    hits = ~built.max_range
    weight = built.support[hits]
    return GaussianMixture.from_parameters(weight / weight.sum(), built.means[hits], built.covariances[hits])
