"""Maps by the names of their methods, built from training scans and scored on held-out scans.

The methods are the forms of evidence of `GaussianMap`, and the baselines.
"""

from __future__ import annotations

import inspect
import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments import baselines
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.experiments.evaluation.metrics import SeenPredictions
from gmmtorch.experiments.evaluation.protocol_options import Protocol
from gmmtorch.experiments.evaluation.queries import UNKNOWN, Queries
from gmmtorch.files import check_writable
from gmmtorch.mapping import METHODS, GaussianMap
from gmmtorch.occupancy import LogOdds, OccupancyGrid, OccupancyMap
from gmmtorch.report import Event, OnRows, Row, ignore
from gmmtorch.scan import Scan

MapFactory = Callable[[float], OccupancyMap]
"""resolution (m) → an empty map."""

BASELINES: dict[str, Callable[..., OccupancyMap]] = {
    "occupancy_grid": OccupancyGrid,
    "occupancy_log_odds": partial(OccupancyGrid, log_odds=LogOdds()),
    "hilbert": baselines.HilbertMap,
    "bayesian_hilbert": baselines.BayesianHilbertMap,
    "bgk": baselines.BGKMap,
    "bgk_points": baselines.BGKPointsMap,
    "gp": baselines.GPMap,
    "ndt": baselines.NDTMap,
    "octomap": baselines.OctoMapMap,
}


@dataclass(frozen=True)
class Form:
    """A factory of `GaussianMap`s that are queried by one form of evidence.

    Forms with the same `new_map` share one map, which is built once.
    """

    new_map: Callable[[], GaussianMap]
    form: str

    def __call__(self, resolution: float) -> GaussianMap:
        return self.new_map()


def methods(
    new_map: Callable[[], GaussianMap], options: Mapping[str, Mapping[str, Any]] | None = None, **limits: Any
) -> dict[str, MapFactory]:
    """Every method by name.

    Args:
        new_map: makes the empty `GaussianMap` that the forms of evidence query.
        options: options of each baseline, by its name. The defaults are those of the baseline's paper, or the
            best on training scans (see docs/baselines.md).
        limits: `memory_limit`, `compiled`, `random_state`: given to the baselines that take them.

    Raises `InvalidArgumentError` for an unknown baseline, or an option that it does not take.
    """
    options = options or {}
    for name in options:
        if name not in BASELINES:
            raise InvalidArgumentError(
                f"method_options.{name} is not known; known are {', '.join(BASELINES)}. The options of "
                "GaussianMap are map.*."
            )
        if not isinstance(options[name], Mapping):
            raise InvalidArgumentError(
                f"method_options.{name}={options[name]!r} must be options, such as {{NAME: VALUE}}."
            )
    return {
        **{form: Form(new_map, form) for form in METHODS},
        **{name: baseline(name, limits, **options.get(name, {})) for name in BASELINES},
    }


def baseline(name: str, limits: Mapping[str, Any], **options: Any) -> MapFactory:
    """A factory of a baseline's maps with these options, and with the limits that it takes."""
    make = BASELINES[name]
    parameters = set(inspect.signature(make).parameters)
    known = parameters - {"resolution"}
    for option in options:
        if option not in known:
            raise InvalidArgumentError(
                f"method_options.{name}.{option} is not known; {name} takes {', '.join(sorted(known))}."
            )
    chosen = {**{key: value for key, value in limits.items() if key in known}, **options}
    if "resolution" in parameters:
        return lambda resolution: make(resolution, **chosen)
    return lambda resolution: make(**chosen)


def choose(names: Sequence[str], known: Mapping[str, MapFactory]) -> dict[str, MapFactory]:
    """The factories with these names, in their order. Raises for an unknown name and lists the known ones."""
    if not names:
        raise InvalidArgumentError(f"method is empty; name at least one of {', '.join(sorted(known))}.")
    for name in names:
        if name not in known:
            raise InvalidArgumentError(f"method={name!r} is not known; known are {', '.join(sorted(known))}.")
    return {name: known[name] for name in names}


_PREDICTED_SCANS = 50  # of which a map without a calibration predicts some beams

Answer = Callable[[Tensor], Tensor]
"""Points (M, D), world metres → occupancy probabilities (M,)."""


@dataclass(frozen=True)
class Built:
    """One map and its score.

    Attributes:
        map: the map. answer: its occupancy by the row's method at the row's resolution.
        row: of results.json.
        asked: the test points. theta: their occupancy probabilities (M,). roc: their ROC curve.
    """

    map: OccupancyMap
    answer: Answer
    row: Row
    asked: Queries
    theta: Tensor
    roc: metrics.Roc


@dataclass
class Outcome:
    """rows: of results.json; shown: the maps of the largest share kept, for the figures."""

    rows: list[Row] = field(default_factory=list)
    shown: list[Built] = field(default_factory=list)


def evaluate(
    name: str,
    scans: Sequence[Scan],
    factories: dict[str, MapFactory],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_row: OnRows = lambda rows: None,
) -> Outcome:
    """Build every method's map for every share kept and resolution, and score each on the same test.

    Args:
        name: of the data set, for the rows.
        scans: in time order, all in memory.
        factories: the methods; see `choose`.
        seed: of the random choice of training data, the free points and the bootstrap.
        on_row: called with all rows so far after each new row, so that a run that fails late keeps its rows.
    """
    if not 0 <= seed < 2**63:
        raise InvalidArgumentError(f"seed={seed} must be a whole number from 0 to 2⁶³ − 1.")
    train_index, test_index = queries.split_indices(len(scans), protocol.test_every)
    train = queries.perturb_poses([scans[i] for i in train_index], protocol.pose_noise, seed)
    origins, ends = queries.test_beams([scans[i] for i in test_index], protocol.max_beams, seed)
    seen_at = [scans[i] for i in train_index]  # at their true poses
    asked = {r: _questions(origins, ends, seen_at, r, protocol, seed) for r in protocol.resolution}
    if protocol.save_queries:
        queries.save_queries(protocol.save_queries, asked, train_index, test_index)
    if protocol.save_map:
        check_writable(Path(protocol.save_map))
    outcome = Outcome()
    for kept in protocol.kept:
        shown = queries.keep_share(train, kept, protocol.removal, seed)
        facts = {"dataset": name, "removal": protocol.removal, "kept": float(kept)}
        facts["n_train_points"] = sum(len(scan.points) for scan in shown)
        # A map that serves several resolutions or forms of evidence is built once.
        cache: dict[Any, tuple[OccupancyMap, float, SeenPredictions | None]] = {}
        for (method, factory), resolution in itertools.product(factories.items(), protocol.resolution):
            shared = factory.new_map if isinstance(factory, Form) else method
            if shared not in cache:
                made = "mixture" if isinstance(factory, Form) else method
                label = f"{made}, {kept:.0%} of the {protocol.removal}"
                cache[shared] = _build(factory(resolution), shown, label, resolution, on_event)
            built, seconds, seen = cache[shared]
            if not built.any_resolution:
                del cache[shared]
            facts |= {"method": method, "resolution": float(resolution), "build_seconds": seconds}
            answer = _answerer(built, factory, resolution)
            scored = _scored(built, answer, asked[resolution], seen, protocol.unknown, seed, facts)
            if protocol.save_map:
                built.save(Path(protocol.save_map) / f"{method}_{kept:g}_{resolution:g}{built.suffix}")
            outcome.rows.append(scored.row)
            on_row(outcome.rows)
            if kept == max(protocol.kept):
                outcome.shown.append(scored)
    return outcome


def _answerer(built: OccupancyMap, factory: MapFactory, resolution: float) -> Answer:
    """Occupancy by the factory's method at a resolution (m), which become defaults of the map."""
    if isinstance(built, GaussianMap):
        built.resolution = resolution
        if isinstance(factory, Form):
            built.method = factory.form
            return lambda points: torch.as_tensor(built.occupancy(points, resolution, factory.form))
    return lambda points: torch.as_tensor(built.occupancy(points, resolution))


def _questions(
    origins: Tensor, ends: Tensor, train: Sequence[Scan], resolution: float, protocol: Protocol, seed: int
) -> Queries:
    asked = queries.hit_and_free(origins, ends, protocol.free, resolution, seed)
    if not protocol.unknown:
        return asked
    # All training scans at their true poses: points that they do not observe are unknown for every share.
    extra = queries.unseen(origins, ends, queries.ray_evidence(train, resolution), seed)
    return Queries(torch.cat([asked.points, extra.points]), torch.cat([asked.labels, extra.labels]))


def _build(
    empty: OccupancyMap, scans: Sequence[Scan], label: str, resolution: float, on_event: Event
) -> tuple[OccupancyMap, float, SeenPredictions | None]:
    """The map of the scans, its build time (s), which includes the fit of an incomplete window, and its
    calibration, if it has none of its own. The build time is without that of the calibration."""
    seen = None if isinstance(empty, GaussianMap) else SeenPredictions(resolution)
    every = max(1, len(scans) // _PREDICTED_SCANS)
    on_event(label, 0, len(scans))
    seconds = 0.0
    for number, scan in enumerate(scans):
        if seen is not None and number % every == every - 1 and number:
            seen.note(lambda points: torch.as_tensor(empty.occupancy(points, resolution)), scan, number)
        begin = time.perf_counter()
        empty.insert(scan)
        seconds += time.perf_counter() - begin
        on_event(label, number + 1, len(scans))
    begin = time.perf_counter()
    empty.finish()
    return empty, seconds + time.perf_counter() - begin, seen


def _scored(
    built: OccupancyMap,
    answer: Answer,
    asked: Queries,
    seen: SeenPredictions | None,
    unknown: bool,
    seed: int,
    facts: Row,
) -> Built:
    """The map with its row, in which the scores follow the facts."""
    begin = time.perf_counter()
    theta = answer(asked.points).cpu()
    seconds = time.perf_counter() - begin
    occupied, free = asked.split(theta)
    known = asked.labels != UNKNOWN
    curve = metrics.roc(occupied, free)
    low, high = metrics.auc_interval(occupied, free, curve.auc, seed)
    scores = metrics.scores(theta[known], asked.labels[known])
    # The scores of a map that has no calibration of its own, with one.
    calibrated = {} if seen is None else metrics.scores(seen.calibrated(theta)[known], asked.labels[known])
    row: Row = {
        **facts,
        "auc": curve.auc,
        "auc_low": low,
        "auc_high": high,
        **scores,
        **{f"calibrated_{name}": calibrated.get(name) for name in ("ece", "log_loss_bits", "accuracy")},
        "n_components": built.n_components if isinstance(built, GaussianMap) else None,
        "nbytes": built.nbytes,
        "query_seconds": seconds,
        "n_queries": theta.shape[0],
    }
    if unknown:
        row |= metrics.unknown_scores(theta[asked.of(UNKNOWN)], free)
    return Built(built, answer, row, asked, theta, curve)
