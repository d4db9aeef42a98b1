"""Rows of missions: times to shares of a reference, and the figures of a mission made by hand."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from gmmtorch.exploration.mission.mission_results import row_of, with_times
from gmmtorch.exploration.world.scoring import BeliefMap, BeliefRule
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.sharing.transport.simulated_network import Reception

VARIANT = {
    "framework": "gmm_shared",
    "planner": "mcts",
    "information": "csqmi",
    "coordination": "greedy",
    "planning_prior": 0.125,
    "codec": "quantized",
    "loss": 0.0,
    "jitter": 0.0,
    "partitions": [],
    "announce": 5.0,
    "budget": None,
}


def row(reduction: list[float], **changes: Any) -> dict[str, Any]:
    """A row of samples each ten seconds, whose entropy falls from 1000 bits."""
    return {
        **VARIANT,
        "times": [10.0 * k for k in range(len(reduction))],
        "entropy_bits": [1000.0 - bits for bits in reduction],
        "observable_bits": 1000.0,
        "entropy_reduction_bits": reduction[-1],
        **changes,
    }


def test_the_reference_is_what_shared_grids_reach_in_the_mean() -> None:
    rows = [
        row([0, 100, 200, 300, 400]),
        row([0, 400, 800, 900, 950]),  # better than any grid, which is no matter
        row([0, 50, 100, 150, 200], framework="grid_shared"),
        row([0, 150, 300, 450, 600], framework="grid_shared"),
        row([0, 20, 40, 60, 80], framework="grid_isolated"),
    ]
    timed = with_times(rows)
    assert {t["reference_bits"] for t in timed} == {400.0}
    assert [t["t50"] for t in timed] == pytest.approx([20.0, 5.0, 40.0, 10 + 10 / 3, None])
    assert [t["t90"] for t in timed] == pytest.approx([36.0, 9.0, None, 24.0, None])
    for before, after in zip(rows, timed, strict=True):
        assert {k: v for k, v in after.items() if k not in ("reference_bits", "t50", "t90")} == before


def test_of_more_variants_of_shared_grids_the_best_is_the_reference() -> None:
    rows = [
        row([0, 300], framework="grid_shared", planner="frontier"),
        row([0, 500], framework="grid_shared", planner="mcts"),
        row([0, 300], framework="grid_shared", planner="mcts"),
        row([0, 900]),
    ]
    assert {t["reference_bits"] for t in with_times(rows)} == {400.0}


def test_without_grids_the_best_variant_is_the_reference() -> None:
    rows = [
        row([0, 300, 600], planner="mcts", seed=0),
        row([0, 100, 400], planner="mcts", seed=1),
        row([0, 100, 700], planner="random", seed=0),  # the best of all trials, but not in the mean
        row([0, 50, 100], planner="random", seed=1),
    ]
    timed = with_times(rows)
    assert {t["reference_bits"] for t in timed} == {500.0}
    assert timed[0]["t50"] == pytest.approx(10 * 250 / 300)
    assert timed[3]["t50"] is None


@pytest.mark.parametrize("name", list(VARIANT))
def test_what_makes_a_variant(name: str) -> None:
    others = {"planning_prior": 0.5, "loss": 0.3, "jitter": 0.1, "partitions": [{"begin": 1.0}]}
    others |= {"announce": 9.0, "budget": 100.0}
    other = others.get(name, "grid_isolated")
    rows = [row([0, 400]), row([0, 600], **{name: other})]
    assert with_times(rows)[0]["reference_bits"] == 600.0
    rows = [row([0, 400], seed=0), row([0, 600], seed=1)]
    assert with_times(rows)[0]["reference_bits"] == 500.0


def test_where_nothing_was_learned_there_is_no_time() -> None:
    (timed,) = with_times([row([0, 0, 0])])
    assert timed["t50"] is None
    assert timed["t90"] is None
    assert with_times([]) == []


# -- a mission by hand --------------------------------------------------------------------------------

SHAPE = (4, 3, 2)
LOW = torch.tensor([5, -2, 0])


def belief(cells: list[list[int]], hits: list[float], misses: list[float], seen: torch.Tensor) -> BeliefMap:
    made = BeliefMap(0.5, Box(LOW, LOW + torch.tensor(SHAPE)), seen, BeliefRule())
    made.add(CellEvidence(torch.tensor(cells) + LOW, torch.tensor(hits), torch.tensor(misses)))
    return made


def mission(lengths: list[float], seen_by: list[int]) -> Any:
    """Three robots in a world of 24 cells, of which all but the last 4 are observable."""
    observable = torch.ones(24, dtype=torch.bool)
    observable[20:] = False
    observable = observable.view(SHAPE)
    occupied = torch.zeros(SHAPE, dtype=torch.bool)
    occupied[0] = True
    cells = [[0, 0, 0], [1, 0, 0], [2, 0, 0]]
    maps = [
        belief(cells, [9.0, 0.0, 0.0], [0.0, 30.0, 30.0], observable),
        belief(cells[:2], [9.0, 0.0], [0.0, 30.0], observable),
        belief(cells[:2], [0.0, 0.0], [30.0, 30.0], observable),
    ]
    mask = torch.zeros(24, dtype=torch.int16)
    mask[: len(seen_by)] = torch.tensor(seen_by, dtype=torch.int16)
    mask[20:] = 7  # not observable: not counted
    names = ["framework", "seed", "planner", "information", "planning_prior", "loss", "duration"]
    names += ["coordination", "codec", "latency", "jitter", "bandwidth", "duplication", "reach"]
    names += ["announce_every", "budget"]
    options = SimpleNamespace(size=3, codecs=("zip",), partitions=(), **dict.fromkeys(names, "x"))
    robots = [
        SimpleNamespace(
            path_length=length,
            collisions=number,
            mapper=SimpleNamespace(components=lambda: None, belief=one),
        )
        for number, (length, one) in enumerate(zip(lengths, maps, strict=True))
    ]
    return SimpleNamespace(
        world=SimpleNamespace(
            observable=observable,
            occupied=occupied,
            resolution=0.5,
            box=Box(LOW, LOW + torch.tensor(SHAPE)),
            name="w",
        ),
        options=options,
        coordination="myopic",
        union=maps[0],
        seen_by=mask,
        robots=robots,
        samples={"raw_points_bytes_over_time": [1, 22], "zip_bytes_over_time": [1, 11]},
        network=SimpleNamespace(
            n_bytes=100,
            n_wire_bytes=128,
            bytes_by_kind=Counter(a=100),
            n_datagrams=1,
            reception=lambda: Reception(1, 100, lost=1),
        ),
        stages={"plan": 1.0},
        now=30.0,
    )


def test_the_figures_of_a_mission_by_hand() -> None:
    # Bits say which robots saw a cell: five cells were seen, three of them by two or more.
    made = mission([1.0, 2.0, 3.0], [1, 0, 3, 7, 4, 0, 6])
    found = row_of(made, 10.0)
    assert found["overlap"] == pytest.approx(3 / 5)
    assert found["path_length"] == 6.0
    assert found["collisions"] == 3
    assert found["coverage_per_metre"] == pytest.approx(3 * 0.5**3 / 6)
    assert found["observed_share"] == pytest.approx(3 / 20)
    # Cells 0 (occupied to some, free to another) and 2 (unknown to two) differ.
    assert found["map_disagreement"] == pytest.approx(2 / 20)
    assert found["entropy_reduction_bits"] == pytest.approx(20 - made.union.entropy_bits)
    assert found["bytes_raw_points"] == 22
    assert found["bytes_zip"] == 11
    assert found["simulated_per_wall_seconds"] == 3.0
    assert found["n_components"] is None
    assert found["partitions"] == []
    assert (found["reception"]["bytes"], found["reception"]["lost"]) == (100, 1)


def test_the_figures_of_a_mission_that_went_nowhere() -> None:
    found = row_of(mission([0.0, 0.0, 0.0], []), 0.0)
    assert found["overlap"] is None
    assert found["coverage_per_metre"] is None
    assert found["simulated_per_wall_seconds"] is None
