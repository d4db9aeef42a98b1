"""The held-out test: maps, test points and rows."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from pillar_room import room_scans, timeless

from gmmtorch import GaussianMap, OccupancyGrid, Scan
from gmmtorch.datasets import load
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import MapFactory, Outcome, Protocol, choose, evaluate, methods

CONTRACT: dict[str, type] = {
    "dataset": str,
    "method": str,
    "resolution": float,
    "removal": str,
    "kept": float,
    "auc": float,
    "brier": float,
    "n_train_points": int,
    "nbytes": int,
    "build_seconds": float,
    "query_seconds": float,
    "n_queries": int,
}
"""Documented fields; `n_components` is an int for mixtures and None for grids."""

UNKNOWN_FIELDS = {"unknown_auc", "unknown_called_free", "unknown_called_occupied", "free_recall"}
SMALL = Protocol(test_every=4, kept=(1.0, 0.3), resolution=(0.2, 0.1))
COARSE = replace(SMALL, resolution=(0.2,))


def small_map() -> GaussianMap:
    return GaussianMap(window=5, n_samples=5_000)


def small_methods() -> dict[str, MapFactory]:
    """Two forms of one mixture, and two grids."""
    return choose(["point", "monte_carlo", "occupancy_grid", "occupancy_log_odds"], methods(small_map))


def run(protocol: Protocol = SMALL, seed: int = 0, **options: Any) -> Outcome:
    """All methods on the room with the pillar."""
    return evaluate("room", room_scans(12), small_methods(), protocol, seed, **options)


@pytest.fixture(scope="module")
def outcome() -> Outcome:
    """The outcome of the small protocol."""
    torch.set_num_threads(1)
    return run()


@pytest.fixture(scope="module")
def plain_rows(outcome) -> list[dict[str, Any]]:
    return outcome.rows


def test_rows_have_every_documented_field_with_its_type(plain_rows):
    rows = plain_rows
    order = [(row["kept"], row["method"], row["resolution"]) for row in rows]
    assert order == [(k, m, r) for k in (1.0, 0.3) for m in small_methods() for r in (0.2, 0.1)]
    for row in rows:
        for name, kind in CONTRACT.items():
            assert type(row[name]) is kind, f"{name} is {row[name]!r}"
        assert isinstance(
            row["n_components"], int if row["method"] in ("point", "monte_carlo") else type(None)
        )
        assert 0.5 < row["auc_low"] <= row["auc"] <= row["auc_high"] <= 1
        assert 0 <= row["brier"] <= 1
        assert min(row["nbytes"], row["n_queries"], row["n_train_points"]) > 0
        assert min(row["build_seconds"], row["query_seconds"]) >= 0
        assert row["dataset"] == "room"
        assert not UNKNOWN_FIELDS & row.keys()
    json.dumps(rows, allow_nan=False)


def test_point_and_query_counts_match_the_split(plain_rows):
    scans, rows = room_scans(12), plain_rows
    n_train = sum(len(scan.points) for i, scan in enumerate(scans) if i % 4)
    n_test = sum(len(scan.points) for i, scan in enumerate(scans) if i % 4 == 0)
    assert {row["n_train_points"] for row in rows if row["kept"] == 1} == {n_train}
    (reduced,) = {row["n_train_points"] for row in rows if row["kept"] == 0.3}
    assert reduced == pytest.approx(0.3 * n_train, rel=0.2)
    assert {row["n_queries"] for row in rows} == {2 * n_test}
    grid = {"occupancy_grid": OccupancyGrid}
    assert {row["n_queries"] for row in evaluate("room", scans, grid, replace(SMALL, max_beams=10)).rows} == {
        20
    }


def test_rows_depend_only_on_the_seed():
    protocol = replace(COARSE, kept=(0.3,), unknown=True, pose_noise=(0.05, 0.02))
    rows = timeless(run(protocol).rows)
    assert timeless(run(protocol).rows) == rows
    assert timeless(run(protocol, seed=1).rows) != rows


class Counted:
    """A map factory that records the maps it makes and the scans that are inserted."""

    def __init__(self, make: MapFactory) -> None:
        self.make = make
        self.resolutions: list[float] = []
        self.scans: list[Scan] = []

    def __call__(self, resolution: float) -> Any:
        self.resolutions.append(resolution)
        made = self.make(resolution)
        insert: Callable[[Scan], None] = made.insert

        def counting(scan: Scan) -> None:
            self.scans.append(scan)
            insert(scan)

        made.insert = counting
        return made


def test_a_mixture_is_built_once_per_share_and_a_grid_once_per_share_and_resolution():
    factories: dict[str, Any] = {name: Counted(make) for name, make in small_methods().items()}
    scans = room_scans(12)
    outcome = evaluate("room", scans, factories, SMALL)
    assert len(factories["monte_carlo"].resolutions) == 2
    assert factories["occupancy_grid"].resolutions == [0.2, 0.1] * 2
    assert len(factories["monte_carlo"].scans) == 2 * 9
    assert len(factories["occupancy_grid"].scans) == 4 * 9
    held_out = {tuple(scan.origin.tolist()) for scan in scans[::4]}
    for counted in factories.values():  # held-out scans are never inserted
        assert not held_out & {tuple(scan.origin.tolist()) for scan in counted.scans}
    seconds = [row["build_seconds"] for row in outcome.rows if row["method"] == "monte_carlo"]
    assert seconds[0] == seconds[1]


def test_shown_maps_are_those_of_the_largest_share(outcome):
    assert [built.row for built in outcome.shown] == [row for row in outcome.rows if row["kept"] == 1]
    for built in outcome.shown:
        assert built.theta.shape == built.asked.labels.shape
        assert built.roc.auc == built.row["auc"]
        assert torch.equal(built.answer(built.asked.points), built.theta)


def test_unknown_points_add_four_fields_and_keep_the_auc(plain_rows, tmp_path):
    events: list[tuple[str, int, int | None]] = []
    rows = run(
        replace(SMALL, unknown=True, save_map=str(tmp_path / "maps")),
        on_event=lambda *event: events.append(event),
    ).rows
    for before, row in zip(plain_rows, rows, strict=True):
        assert row.keys() - before.keys() == UNKNOWN_FIELDS
        assert all(type(row[name]) is float and 0 <= row[name] <= 1 for name in UNKNOWN_FIELDS)
        assert row["n_queries"] > before["n_queries"]
        assert row["auc"] == before["auc"]  # hit and free points are the same
    grids = [row for row in rows if row["method"] == "occupancy_grid"]
    # No training beam observes the unknown points, so a grid answers exactly ½.
    assert all(row["unknown_called_free"] == row["unknown_called_occupied"] == 0 for row in grids)
    assert {path.name for path in (tmp_path / "maps").iterdir()} == {
        f"{method}_{kept}_{resolution}.safetensors"
        for method in small_methods()
        for kept in ("1", "0.3")
        for resolution in ("0.2", "0.1")
    }
    stages = {stage for stage, _, _ in events}
    assert any("mixture" in stage and "30%" in stage for stage in stages)
    for stage in stages:
        steps = [(done, total) for name, done, total in events if name == stage]
        assert steps[0] == (0, 9)
        assert steps[-1] == (9, 9)


# -- invalid input --------------------------------------------------------------------------------


def test_chosen_methods_are_known_and_keep_their_order():
    known, names = methods(small_map), ["monte_carlo", "occupancy_grid"]
    assert list(choose(names, known)) == names
    with pytest.raises(InvalidArgumentError, match="method='octree' is not known") as caught:
        choose(["monte_carlo", "octree"], known)
    assert all(name in str(caught.value) for name in known)
    with pytest.raises(InvalidArgumentError, match=r"method is empty.*monte_carlo"):
        choose([], known)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": (0.1, -0.1)}, "resolution=-0.1"),
        ({"resolution": ()}, r"resolution=\[\] is empty"),
        ({"kept": ()}, r"kept=\[\] is empty"),
        ({"max_beams": 0}, "max_beams=0"),
        ({"kept": (1.0, 2.0)}, "kept=2"),
        ({"kept": (0.0,)}, "kept=0"),
        ({"test_every": 1}, "test_every=1"),
        ({"free": "behind"}, "free='behind'"),
        ({"pose_noise": (0.1,)}, "pose_noise="),
        ({"pose_noise": (-1.0, 0.0)}, "pose_noise="),
        ({"pose_noise": (0.0, float("inf"))}, "pose_noise="),
    ],
)
def test_an_invalid_protocol_raises_when_it_is_made(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Protocol(**options)


@pytest.mark.parametrize("seed", [-1, 2**70])
def test_an_invalid_seed_raises(seed):
    with pytest.raises(InvalidArgumentError, match=f"seed={seed}"):
        run(replace(SMALL, kept=(1.0,), resolution=(0.2,)), seed=seed)


def test_maps_without_training_beams_answer_one_half():
    """A tiny share keeps no beam."""
    rows = run(replace(COARSE, kept=(1e-6,))).rows
    assert {row["n_train_points"] for row in rows} == {0}
    assert all(row["auc"] == 0.5 and row["brier"] == 0.25 for row in rows)


# -- the mixture against the grid -----------------------------------------------------------------


def test_mixture_beats_the_grid_on_a_tenth_of_the_beams():
    scans = list(load("synthetic_building_2d"))
    known = methods(lambda: GaussianMap(n_samples=200_000))
    chosen = choose(["occupancy_grid", "monte_carlo"], known)
    grid, mixture = evaluate("building", scans, chosen, Protocol(kept=(0.1,))).rows
    assert mixture["auc"] >= grid["auc"]
    assert mixture["nbytes"] < grid["nbytes"]


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_rows_on_cuda_match_the_cpu():
    protocol = replace(COARSE, unknown=True, pose_noise=(0.01, 0.01))
    scans = [scan.to("cuda") for scan in room_scans(12)]
    rows = evaluate("room", scans, small_methods(), protocol).rows
    for row, same in zip(rows, run(protocol).rows, strict=True):
        assert row["auc"] == pytest.approx(same["auc"], abs=0.01)
