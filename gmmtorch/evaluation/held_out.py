"""Maps built from training scans, and their scores on held-out ones."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.evaluation import calibration, metrics, queries, split
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.evaluation.methods import Form, MapFactory
from gmmtorch.evaluation.queries import FREE, OCCUPIED, UNKNOWN, Queries
from gmmtorch.files import check_writable
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.protocol import OccupancyMap
from gmmtorch.scan import Scan


def _ignore_rows(rows: list[dict[str, Any]]) -> None:
    """Nobody wants them before the end."""


@dataclass(frozen=True)
class Protocol:
    """The test, as the options `evaluation.*` describe it; see docs/commands.md.

    max_beams: held-out beams asked about at most; more are thinned at random.
    """

    test_every: int = 10
    kept: Sequence[float] = (1.0,)
    removal: split.Removal = "beams"
    resolution: Sequence[float] = (0.1,)
    free: queries.FreePoints = "uniform"
    unknown: bool = False
    pose_noise: Sequence[float] = (0.0, 0.0)
    max_beams: int = 1_000_000
    save_queries: str | None = None
    save_map: str | None = None

    def __post_init__(self) -> None:
        if not self.kept or not self.resolution:
            raise InvalidArgumentError(
                "evaluation.kept and evaluation.resolution need at least one value each."
            )
        # All at once and before any map is built, which may take hours.
        for value in self.resolution:
            check_resolution(value)
        for share in self.kept:
            split.check_share(share)
        split.check_removal(self.removal)
        split.check_test_every(self.test_every)
        split.check_noise(self.pose_noise)
        queries.check_free(self.free)
        if self.max_beams < 1:
            raise InvalidArgumentError(f"max_beams={self.max_beams} must be at least 1.")


Answer = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class Built:
    """One map, and what it answered: `theta` (M,) for `asked`, a row of results, the ROC curve.

    answer: the method's occupancy (M,) of any points (M, D), at the row's resolution.
    """

    map: OccupancyMap
    answer: Answer
    row: dict[str, Any]
    asked: Queries
    theta: Tensor
    roc: metrics.Roc


@dataclass
class Outcome:
    """rows: as in results.json; shown: the maps of the largest share kept, which figures show."""

    rows: list[dict[str, Any]] = field(default_factory=list)
    shown: list[Built] = field(default_factory=list)


def evaluate(
    name: str,
    scans: Sequence[Scan],
    factories: dict[str, MapFactory],
    protocol: Protocol,
    seed: int = 0,
    on_event: Event = ignore,
    on_row: Callable[[list[dict[str, Any]]], object] = _ignore_rows,
) -> Outcome:
    """Build every method's map for every share kept and resolution, and score each on the same test.

    Args:
        name: of the data set, for the rows.
        scans: in the order they were taken, all in memory.
        factories: the methods, see `choose`.
        protocol: the test.
        seed: of the split's thinning, the free points and the bootstrap.
        on_event: told of progress.
        on_row: given all rows so far, whenever there is another: so that a run that fails late has
            something to show.
    """
    if not 0 <= seed < 2**63:
        raise InvalidArgumentError(f"seed={seed} must be a whole number from 0 to 2⁶³ − 1.")
    train_index, test_index = split.split_indices(len(scans), protocol.test_every)
    train = split.perturb_poses([scans[i] for i in train_index], protocol.pose_noise, seed)
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
        shown = split.keep_share(train, kept, protocol.removal, seed)
        # A map that answers at any resolution, and by any form, is built once and asked again.
        at_hand: dict[Any, tuple[OccupancyMap, float]] = {}
        for method, factory in factories.items():
            label = (
                f"{'mixture' if isinstance(factory, Form) else method}, {kept:.0%} of the {protocol.removal}"
            )
            shared = factory.new_map if isinstance(factory, Form) else method
            for resolution in protocol.resolution:
                if shared not in at_hand:
                    at_hand[shared] = _build(factory(resolution), shown, label, on_event)
                built, seconds = at_hand[shared]
                if not built.any_resolution:
                    del at_hand[shared]
                _aim(built, factory, resolution)
                answer = _answerer(built, factory, resolution)
                made = _score(built, answer, asked[resolution], resolution, seed, protocol.unknown)
                made.row.update(
                    dataset=name,
                    method=method,
                    removal=protocol.removal,
                    kept=float(kept),
                    n_train_points=sum(scan.points.shape[0] for scan in shown),
                    build_seconds=seconds,
                )
                if protocol.save_map:
                    built.save(Path(protocol.save_map) / f"{method}_{kept:g}_{resolution:g}{built.suffix}")
                outcome.rows.append({key: made.row[key] for key in sorted(made.row, key=_column)})
                on_row(outcome.rows)
                if kept == largest:
                    outcome.shown.append(made)
    return outcome


def _answerer(built: OccupancyMap, factory: MapFactory, resolution: float) -> Answer:
    """The method's occupancy at a resolution."""
    if isinstance(factory, Form) and isinstance(built, GaussianMap):
        return lambda points: torch.as_tensor(built.occupancy(points, resolution, factory.form))
    return lambda points: torch.as_tensor(built.occupancy(points, resolution))


def _aim(built: OccupancyMap, factory: MapFactory, resolution: float) -> None:
    """Let the map, and its file, answer by this method and at this resolution unless told otherwise."""
    if isinstance(built, GaussianMap):
        built.resolution = resolution
        built.method = factory.form if isinstance(factory, Form) else built.method


def _questions(
    origins: Tensor, ends: Tensor, train: Sequence[Scan], resolution: float, protocol: Protocol, seed: int
) -> Queries:
    asked = queries.hit_and_free(origins, ends, protocol.free, resolution, seed)
    if not protocol.unknown:
        return asked
    # Of all training rays, at their true poses: what they did not see, no share of them saw.
    extra = queries.unseen(origins, ends, queries.touched(train, resolution), seed)
    return Queries(torch.cat([asked.points, extra.points]), torch.cat([asked.labels, extra.labels]))


def _build(
    empty: OccupancyMap, scans: Sequence[Scan], label: str, on_event: Event
) -> tuple[OccupancyMap, float]:
    """The map of the scans, and the seconds it took, an unfinished window's fit included."""
    on_event(label, 0, len(scans))
    begin = time.perf_counter()
    for number, scan in enumerate(scans, 1):
        empty.insert(scan)
        on_event(label, number, len(scans))
    empty.finish()
    return empty, time.perf_counter() - begin


def _score(
    built: OccupancyMap, answer: Answer, asked: Queries, resolution: float, seed: int, unknown: bool
) -> Built:
    begin = time.perf_counter()
    theta = answer(asked.points).cpu()
    seconds = time.perf_counter() - begin
    occupied, free = theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]
    known = asked.labels != UNKNOWN
    curve = metrics.roc(occupied, free)
    low, high = metrics.auc_interval(occupied, free, curve.auc, seed)
    row: dict[str, Any] = {
        "resolution": float(resolution),
        "auc": curve.auc,
        "auc_low": low,
        "auc_high": high,
        "brier": metrics.brier(occupied, free),
        **calibration.scores(theta[known], asked.labels[known]),
        "n_components": built.n_components if isinstance(built, GaussianMap) else None,
        "nbytes": built.nbytes,
        "query_seconds": seconds,
        "n_queries": theta.shape[0],
    }
    if unknown:
        row |= metrics.unknown_scores(theta[asked.of(UNKNOWN)], free)
    return Built(built, answer, row, asked, theta, curve)


_COLUMNS = [
    "dataset",
    "method",
    "resolution",
    "removal",
    "kept",
    "auc",
    "auc_low",
    "auc_high",
    "brier",
    "ece",
    "log_loss_bits",
    "accuracy",
    "n_train_points",
    "n_components",
    "nbytes",
    "build_seconds",
    "query_seconds",
    "n_queries",
]


def _column(name: str) -> tuple[int, str]:
    """Order of the fields of a row: those of the contract first."""
    return (_COLUMNS.index(name) if name in _COLUMNS else len(_COLUMNS), name)
