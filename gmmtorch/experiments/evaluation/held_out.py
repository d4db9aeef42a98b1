"""Builds maps from training scans and scores them on held-out scans."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.experiments.evaluation.mapping_methods import Form, MapFactory
from gmmtorch.experiments.evaluation.metrics import SeenPredictions
from gmmtorch.experiments.evaluation.protocol_options import Protocol
from gmmtorch.experiments.evaluation.queries import UNKNOWN, Queries
from gmmtorch.files import check_writable
from gmmtorch.mapping import GaussianMap
from gmmtorch.occupancy import OccupancyMap
from gmmtorch.report import Event, OnRows, Row, ignore
from gmmtorch.scan import Scan

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
        protocol: the test.
        seed: of the random choice of training data, the free points and the bootstrap.
        on_event: progress callback.
        on_row: called with all rows so far after each new row, so that a run that fails late keeps its rows.
    """
    if not 0 <= seed < 2**63:
        raise InvalidArgumentError(f"seed={seed} must be a whole number from 0 to 2⁶³ − 1.")
    train_index, test_index = queries.split_indices(len(scans), protocol.test_every)
    train = queries.perturb_poses([scans[i] for i in train_index], protocol.pose_noise, seed)
    origins, ends = queries.test_beams([scans[i] for i in test_index], protocol.max_beams, seed)
    asked = {
        r: _questions(origins, ends, [scans[i] for i in train_index], r, protocol, seed)
        for r in protocol.resolution
    }
    if protocol.save_queries:
        queries.save_queries(protocol.save_queries, asked, train_index, test_index)
    if protocol.save_map:
        check_writable(Path(protocol.save_map))
    outcome = Outcome()
    largest = max(protocol.kept)
    for kept in protocol.kept:
        shown = queries.keep_share(train, kept, seed)
        for method, resolution, built, seconds, answer, seen in _built_maps(
            factories, shown, kept, protocol, on_event
        ):
            case = {"dataset": name, "method": method, "resolution": float(resolution)}
            case |= {"removal": "beams", "kept": float(kept)}
            effort = {"build_seconds": seconds, "n_train_points": sum(len(scan.points) for scan in shown)}
            made = _score(built, answer, asked[resolution], seen, seed, protocol.unknown, case, effort)
            if protocol.save_map:
                built.save(Path(protocol.save_map) / f"{method}_{kept:g}_{resolution:g}{built.suffix}")
            outcome.rows.append(made.row)
            on_row(outcome.rows)
            if kept == largest:
                outcome.shown.append(made)
    return outcome


def _built_maps(
    factories: dict[str, MapFactory], shown: Sequence[Scan], kept: float, protocol: Protocol, on_event: Event
) -> Iterator[tuple[str, float, OccupancyMap, float, Answer, SeenPredictions | None]]:
    """Method, resolution, map, seconds of its building, its answers, and the calibration of a map that has
    none of its own, for each method and resolution."""
    # A map that serves several resolutions or forms of evidence is built once.
    cache: dict[Any, tuple[OccupancyMap, float, SeenPredictions | None]] = {}
    for method, factory in factories.items():
        made_as = "mixture" if isinstance(factory, Form) else method
        shared = factory.new_map if isinstance(factory, Form) else method
        for resolution in protocol.resolution:
            if shared not in cache:
                label = f"{made_as}, {kept:.0%} of the beams"
                cache[shared] = _build(factory(resolution), shown, label, resolution, on_event)
            built, seconds, seen = cache[shared]
            if not built.any_resolution:
                del cache[shared]
            yield method, resolution, built, seconds, _answerer(built, factory, resolution), seen


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


def _score(
    built: OccupancyMap,
    answer: Answer,
    asked: Queries,
    seen: SeenPredictions | None,
    seed: int,
    unknown: bool,
    case: Row,
    effort: Row,
) -> Built:
    """The map with its row: the case, the scores, and the effort, in the order of the documentation."""
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
        **case,
        "auc": curve.auc,
        "auc_low": low,
        "auc_high": high,
        "brier": scores["brier"],
        **scores,
        **{f"calibrated_{name}": calibrated.get(name) for name in ("ece", "log_loss_bits", "accuracy")},
        "n_train_points": effort["n_train_points"],
        "n_components": built.n_components if isinstance(built, GaussianMap) else None,
        "nbytes": built.nbytes,
        "build_seconds": effort["build_seconds"],
        "query_seconds": seconds,
        "n_queries": theta.shape[0],
    }
    if unknown:
        row |= metrics.unknown_scores(theta[asked.of(UNKNOWN)], free)
    return Built(built, answer, row, asked, theta, curve)
