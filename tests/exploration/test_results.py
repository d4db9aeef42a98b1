"""Rows and snapshots of missions; entropy, accuracy and disagreement: against values by hand and loops."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import mannwhitneyu
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence
from gmmtorch.team.exploration import BeliefRule, Snapshots, TeamOptions, differing, variant_of
from gmmtorch.team.exploration.mission.results import VARIANT, mission_row, with_network_costs, with_times
from gmmtorch.team.exploration.world.scoring import BeliefMap, accuracy, disagreement
from gmmtorch.team.sharing.transport.simulated_network import Reception, Traffic

OPTIONS = {
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
    """A row with a sample every ten seconds, whose entropy falls from 1000 bits."""
    return {
        **OPTIONS,
        "times": [10.0 * k for k in range(len(reduction))],
        "entropy_bits": [1000.0 - bits for bits in reduction],
        "observable_bits": 1000.0,
        "entropy_reduction_bits": reduction[-1],
        **changes,
    }


def test_reference_is_the_mean_reduction_of_shared_grids() -> None:
    rows = [
        row([0, 100, 200, 300, 400]),
        row([0, 400, 800, 900, 950]),  # better than any grid, without effect
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


def test_reference_without_grids_is_the_best_variant() -> None:
    rows = [
        row([0, 300, 600], planner="mcts", seed=0),
        row([0, 100, 400], planner="mcts", seed=1),
        row([0, 100, 700], planner="random", seed=0),  # the best trial, but not the best mean
        row([0, 50, 100], planner="random", seed=1),
    ]
    timed = with_times(rows)
    assert {t["reference_bits"] for t in timed} == {500.0}
    assert timed[0]["t50"] == pytest.approx(10 * 250 / 300)
    assert timed[3]["t50"] is None


@pytest.mark.parametrize("name", list(OPTIONS))
def test_fields_that_make_a_variant(name: str) -> None:
    others = {"planning_prior": 0.5, "loss": 0.3, "jitter": 0.1, "partitions": [{"begin": 1.0}]}
    others |= {"announce": 9.0, "budget": 100.0}
    other = others.get(name, "grid_isolated")
    rows = [row([0, 400]), row([0, 600], **{name: other})]
    assert with_times(rows)[0]["reference_bits"] == 600.0
    rows = [row([0, 400], seed=0), row([0, 600], seed=1)]
    assert with_times(rows)[0]["reference_bits"] == 500.0


# -- a mission with known values ----------------------------------------------------------------------

SHAPE = (4, 3, 2)
LOW = torch.tensor([5, -2, 0])


def belief(cells: list[list[int]], hits: list[float], misses: list[float], seen: torch.Tensor) -> BeliefMap:
    made = BeliefMap(0.5, Box(LOW, LOW + torch.tensor(SHAPE)), seen, BeliefRule())
    made.add(CellEvidence(torch.tensor(cells) + LOW, torch.tensor(hits), torch.tensor(misses)))
    return made


def mission(lengths: list[float], seen_by: list[int]) -> Any:
    """Three robots in a world of 24 cells; the last 4 are not observable."""
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
    options = TeamOptions(size=3, codecs=("octree",))
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
        score=SimpleNamespace(
            union=maps[0],
            seen_by=mask,
            samples={"raw_points_bytes_over_time": [1, 22], "octree_bytes_over_time": [1, 11]},
        ),
        robots=robots,
        network=SimpleNamespace(
            bytes_by_kind=Counter(a=100),
            traffic=lambda: Traffic(1, 100),
            reception=lambda: Reception(1, 100, lost=1),
        ),
        watch=SimpleNamespace(seconds={"plan": 1.0}),
        elapsed=30.0,
    )


def test_fields_of_a_mission_row() -> None:
    # seen_by has a bit per robot: five cells were seen, three of them by two or more robots.
    made = mission([1.0, 2.0, 3.0], [1, 0, 3, 7, 4, 0, 6])
    found = mission_row(made, 10.0)
    assert found["overlap"] == pytest.approx(3 / 5)
    assert found["path_length"] == 6.0
    assert found["collisions"] == 3
    assert found["coverage_per_metre"] == pytest.approx(3 * 0.5**3 / 6)
    assert found["observed_share"] == pytest.approx(3 / 20)
    # The maps differ in cells 0 (occupied or free) and 2 (unknown to two robots).
    assert found["map_disagreement"] == pytest.approx(2 / 20)
    assert found["entropy_reduction_bits"] == pytest.approx(20 - made.score.union.entropy_bits)
    assert found["bytes_raw_points"] == 22
    assert found["bytes_octree"] == 11
    assert found["simulated_per_wall_seconds"] == 3.0
    assert found["n_components"] is None
    assert found["partitions"] == []
    assert (found["reception"]["bytes"], found["reception"]["lost"]) == (100, 1)


def test_fields_of_a_mission_without_motion() -> None:
    found = mission_row(mission([0.0, 0.0, 0.0], []), 0.0)
    assert found["overlap"] is None
    assert found["coverage_per_metre"] is None
    assert found["simulated_per_wall_seconds"] is None


# -- costs of networks --------------------------------------------------------------------------------

MINUTE = {"begin": 60.0, "end": 120.0, "groups": [[0], [1, 2]]}


def network_row(seed: int = 0, missing: list[float] | None = None, **changes: Any) -> dict[str, Any]:
    """A row with a sample every twenty seconds."""
    missing = [0.0] if missing is None else missing
    return {
        "framework": "gmm_shared",
        "seed": seed,
        "loss": 0.0,
        "partitions": [],
        "delay": 0.05,
        "entropy_reduction_bits": 1000.0,
        "wire_bytes": 500,
        "t90": 200.0,
        "times": [20.0 * i for i in range(len(missing))],
        "missing_share": missing,
        **changes,
    }


def test_costs_compare_with_the_lossless_mission_of_the_same_seed() -> None:
    rows = [
        network_row(0),
        network_row(1, wire_bytes=400, t90=100.0),
        network_row(0, loss=0.5, wire_bytes=750, t90=250.0),
        network_row(1, loss=0.5, wire_bytes=1000, t90=90.0),
        network_row(1, partitions=[MINUTE], wire_bytes=440, t90=110.0),
    ]
    found = with_network_costs(rows)
    assert [made["wire_ratio"] for made in found] == pytest.approx([1, 1, 1.5, 2.5, 1.1])
    assert [made["t90_ratio"] for made in found] == pytest.approx([1, 1, 1.25, 0.9, 1.1])
    assert [made["bits_per_byte"] for made in found] == pytest.approx([2, 2.5, 4 / 3, 1, 1000 / 440])
    added = {"wire_ratio", "t90_ratio", "bits_per_byte", "healed_after"}
    for before, after in zip(rows, found, strict=True):
        assert {k: v for k, v in after.items() if k not in added} == before


@pytest.mark.parametrize("other", [{"framework": "grid_shared"}, {"delay": 0.2}, {"seed": 1}, {"loss": 0.1}])
def test_no_ratio_to_a_mission_of_another_variant(other: dict[str, Any]) -> None:
    _, found = with_network_costs([network_row(**other), network_row(loss=0.3)])
    assert found["wire_ratio"] is found["t90_ratio"] is None
    assert found["bits_per_byte"] == 2


def test_no_ratio_where_nothing_was_sent_or_reached() -> None:
    alone, never = with_network_costs(
        [network_row(framework="grid_isolated", wire_bytes=0), network_row(framework="grid_shared", t90=None)]
    )
    assert alone["bits_per_byte"] is alone["wire_ratio"] is None
    assert alone["t90_ratio"] == 1
    assert never["t90_ratio"] is None
    assert with_network_costs([]) == []


def test_healed_after_is_when_the_missing_share_is_as_small_as_without_partition() -> None:
    #       0    20   40   60    80    100   120  140  160   180
    usual = [0.9, 0.5, 0.3, 0.02, 0.04, 0.01, 0.0, 0.0, 0.00, 0.0]  # at most 0.04 in the minute
    parted = [0.9, 0.5, 0.3, 0.02, 0.30, 0.50, 0.6, 0.2, 0.04, 0.0]
    lossless, found = with_network_costs(
        [network_row(missing=usual), network_row(missing=parted, partitions=[MINUTE])]
    )
    assert lossless["healed_after"] is None
    assert found["healed_after"] == 40  # 160 s
    _, never = with_network_costs(
        [network_row(missing=usual), network_row(missing=parted[:8], partitions=[MINUTE])]
    )
    assert never["healed_after"] is None
    (alone,) = with_network_costs([network_row(missing=parted, partitions=[MINUTE])])
    assert alone["healed_after"] is None


def test_healed_after_uses_the_partition_that_ends_last() -> None:
    usual, parted = [0.0, 0.1, 0.1, 0.2, 0.0, 0.0], [0.0, 0.5, 0.0, 0.9, 0.9, 0.15]
    cuts = [{**MINUTE, "begin": 40.0, "end": 80.0}, {**MINUTE, "begin": 10.0, "end": 30.0}]
    rows = [network_row(missing=usual), network_row(missing=parted, partitions=cuts)]
    assert with_network_costs(rows)[1]["healed_after"] == 20
    between = [{**MINUTE, "begin": 45.0, "end": 55.0}]  # between two samples
    assert with_network_costs([rows[0], {**rows[1], "partitions": between}])[1]["healed_after"] is None


def test_differing_names_the_fields_of_variants_only() -> None:
    rows = [network_row(0), network_row(1, wire_bytes=9), network_row(0, loss=0.1, partitions=[MINUTE])]
    assert differing(rows) == ["loss", "partitions"]
    assert differing(rows, without=["loss"]) == ["partitions"]
    assert differing(rows[:2]) == differing([]) == []
    assert variant_of(rows[0]) == variant_of(rows[1]) != variant_of(rows[2])
    assert len(variant_of(rows[0], without=["loss"])) == len(VARIANT) - 1
    assert variant_of(rows[2], ["loss"]) == (0.1,)


# -- snapshots --------------------------------------------------------------------------------------

OBSERVABLE = 1e6

CURVES: dict[str, Callable[[float], float]] = {
    "linear": lambda share: share,
    "early": lambda share: min(1.0, 4 * share),
    "small": lambda share: share / 1000,
    "in steps": lambda share: round(10 * share) / 10,
}


def flown(learned: Callable[[float], float], n: int) -> Snapshots:
    """The snapshots of a mission of n ticks."""
    snapshots = Snapshots(lambda mission: {"taken at": mission.n_ticks})
    for tick in range(1, n + 1):
        union = SimpleNamespace(observable_bits=OBSERVABLE, entropy_bits=OBSERVABLE * (1 - learned(tick / n)))
        mission: Any = SimpleNamespace(n_ticks=tick, is_over=tick == n, score=SimpleNamespace(union=union))
        snapshots.update(mission)
    return snapshots


@pytest.mark.parametrize("n", [100, 1600])
@pytest.mark.parametrize("learned", CURVES.values(), ids=CURVES.keys())
def test_snapshots_are_few_and_the_chosen_ones_are_at_the_given_shares(learned: Any, n: int) -> None:
    full = flown(learned, n)
    assert len(full.taken) <= 17
    chosen = full.chosen()
    assert len(chosen) == 4
    assert chosen[-1].tick == n
    shares = [snapshot.bits / chosen[-1].bits for snapshot in chosen]
    assert shares == pytest.approx([0.2, 0.5, 0.8, 1.0], abs=1 / 14)
    assert all(snapshot.content == {"taken at": snapshot.tick} for snapshot in full.taken)


@pytest.mark.parametrize(("n", "ticks"), [(1, [1]), (2, [1, 2]), (3, [1, 2, 3]), (8, [2, 4, 6, 8])])
def test_short_missions_have_fewer_snapshots(n: int, ticks: list[int]) -> None:
    assert [snapshot.tick for snapshot in flown(lambda share: share, n).chosen()] == ticks


def test_entropy_that_rises_gives_no_snapshot_except_the_last() -> None:
    full = flown(lambda share: 1 - share / 2, 10)
    assert [snapshot.tick for snapshot in full.taken] == [1, 10]


BOX = Box(torch.tensor([-3, 2, 0]), torch.tensor([9, 11, 7]))


def evidence(seed: int, n: int = 60) -> CellEvidence:
    """Random evidence of cells inside and outside the box."""
    g = torch.Generator().manual_seed(seed)
    cells = torch.unique(torch.randint(-5, 14, (n, 3), generator=g), dim=0)
    hits = torch.randint(0, 3, (len(cells),), generator=g).float()
    return CellEvidence(cells, hits, 3 * torch.rand(len(cells), generator=g))


def observable(seed: int = 0) -> Tensor:
    return torch.rand(BOX.shape, generator=torch.Generator().manual_seed(seed)) < 0.7


def entropy_by_hand(belief: BeliefMap, seen: Tensor, rule: BeliefRule) -> float:
    total = 0.0
    cells = seen.nonzero() + BOX.low
    for h, m in zip(*(x.tolist() for x in belief.grid.at_cells(cells)), strict=True):
        p = min(max((h + rule.prior) / (h + m + 2 * rule.prior), rule.clamp), 1 - rule.clamp)
        total -= p * math.log2(p) + (1 - p) * math.log2(1 - p)
    return total


@given(seeds=st.lists(st.integers(0, 1000), max_size=6), clamp=st.sampled_from([0.01, 0.05, 0.2]))
def test_belief_entropy_equals_the_sum_over_observable_cells(seeds: list[int], clamp: float) -> None:
    rule, seen = BeliefRule(clamp=clamp), observable()
    belief = BeliefMap(0.5, BOX, seen, rule)
    for seed in seeds:
        belief.add(evidence(seed))
    assert belief.entropy_bits == pytest.approx(entropy_by_hand(belief, seen, rule), abs=1e-3)
    h, m = belief.grid.at_cells(seen.nonzero() + BOX.low)
    assert belief.n_observed == int(((h + m) > 0).sum())


def test_accuracy_equals_a_loop_and_the_rank_statistic() -> None:
    seen = observable()
    belief = BeliefMap(0.5, BOX, seen, BeliefRule())
    for seed in range(4):
        belief.add(evidence(seed))
    cells = seen.nonzero() + BOX.low
    occupied = torch.rand(len(cells), generator=torch.Generator().manual_seed(3)) < 0.3
    p = belief.probability(cells).double().tolist()
    right = [a if o else 1 - a for a, o in zip(p, occupied.tolist(), strict=True)]
    parts = [[a for a, o in zip(p, occupied.tolist(), strict=True) if o == kind] for kind in (True, False)]
    found = accuracy(belief, cells, occupied)
    assert found["cross_entropy_bits"] == pytest.approx(-sum(map(math.log2, right)) / len(right))
    assert found["auc"] == pytest.approx(mannwhitneyu(*parts).statistic / len(parts[0]) / len(parts[1]))


def test_accuracy_has_no_auc_for_cells_of_one_class() -> None:
    belief = BeliefMap(0.5, BOX, observable(), BeliefRule())
    assert accuracy(belief, torch.tensor([[0, 3, 1]]), torch.tensor([True]))["auc"] is None


def test_disagreement_counts_cells_in_different_classes() -> None:
    maps = [BeliefMap(0.5, BOX, observable(), BeliefRule()) for _ in range(3)]
    cells = torch.tensor([[0, 3, 1], [0, 3, 2], [0, 3, 3], [0, 3, 4]])
    free = CellEvidence(cells[:1], torch.zeros(1), torch.full((1,), 20.0))
    for belief in maps:
        belief.add(free)
    assert disagreement(maps, cells) == 0
    maps[1].add(CellEvidence(cells[1:2], torch.full((1,), 20.0), torch.zeros(1)))
    assert disagreement(maps, cells) == 0.25
    assert disagreement(maps[:1], cells) is None


@pytest.mark.parametrize("options", [{"clamp": 0.5}, {"clamp": -0.1}, {"prior": -1.0}, {"free": 0.9}])
def test_belief_rule_rejects_bad_values(options: dict[str, float]) -> None:
    with pytest.raises(InvalidArgumentError):
        BeliefRule(**options)
