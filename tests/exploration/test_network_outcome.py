"""What networks cost missions, against figures worked out by hand."""

from __future__ import annotations

from typing import Any

import pytest

from gmmtorch.exploration.mission.network_results import with_network_costs
from gmmtorch.exploration.mission.variants import VARIANT, differing, variant_of

MINUTE = {"begin": 60.0, "end": 120.0, "groups": [[0], [1, 2]]}


def row(seed: int = 0, missing: list[float] | None = None, **changes: Any) -> dict[str, Any]:
    """A mission with samples each twenty seconds, from 0 on."""
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


def test_each_is_compared_with_the_lossless_one_of_its_seed() -> None:
    rows = [
        row(0),
        row(1, wire_bytes=400, t90=100.0),
        row(0, loss=0.5, wire_bytes=750, t90=250.0),
        row(1, loss=0.5, wire_bytes=1000, t90=90.0),
        row(1, partitions=[MINUTE], wire_bytes=440, t90=110.0),
    ]
    found = with_network_costs(rows)
    assert [made["wire_ratio"] for made in found] == pytest.approx([1, 1, 1.5, 2.5, 1.1])
    assert [made["t90_ratio"] for made in found] == pytest.approx([1, 1, 1.25, 0.9, 1.1])
    assert [made["bits_per_byte"] for made in found] == pytest.approx([2, 2.5, 4 / 3, 1, 1000 / 440])
    added = {"wire_ratio", "t90_ratio", "bits_per_byte", "healed_after"}
    for before, after in zip(rows, found, strict=True):
        assert {k: v for k, v in after.items() if k not in added} == before


@pytest.mark.parametrize("other", [{"framework": "grid_shared"}, {"delay": 0.2}, {"seed": 1}, {"loss": 0.1}])
def test_there_is_no_ratio_to_a_mission_of_another_kind(other: dict[str, Any]) -> None:
    _, found = with_network_costs([row(**other), row(loss=0.3)])
    assert found["wire_ratio"] is found["t90_ratio"] is None
    assert found["bits_per_byte"] == 2


def test_nothing_is_divided_by_nothing() -> None:
    alone, never = with_network_costs(
        [row(framework="grid_isolated", wire_bytes=0), row(framework="grid_shared", t90=None)]
    )
    assert alone["bits_per_byte"] is alone["wire_ratio"] is None
    assert alone["t90_ratio"] == 1
    assert never["t90_ratio"] is None
    assert with_network_costs([]) == []


def test_a_cut_team_is_whole_once_it_lacks_no_more_than_the_lossless_one_did() -> None:
    #       0    20   40   60    80    100   120  140  160   180
    usual = [0.9, 0.5, 0.3, 0.02, 0.04, 0.01, 0.0, 0.0, 0.00, 0.0]  # at most 0.04 in the minute
    parted = [0.9, 0.5, 0.3, 0.02, 0.30, 0.50, 0.6, 0.2, 0.04, 0.0]
    lossless, found = with_network_costs([row(missing=usual), row(missing=parted, partitions=[MINUTE])])
    assert lossless["healed_after"] is None
    assert found["healed_after"] == 40  # 160 s
    _, never = with_network_costs([row(missing=usual), row(missing=parted[:8], partitions=[MINUTE])])
    assert never["healed_after"] is None
    (alone,) = with_network_costs([row(missing=parted, partitions=[MINUTE])])
    assert alone["healed_after"] is None


def test_of_several_partitions_the_last_to_end_counts() -> None:
    usual, parted = [0.0, 0.1, 0.1, 0.2, 0.0, 0.0], [0.0, 0.5, 0.0, 0.9, 0.9, 0.15]
    cuts = [{**MINUTE, "begin": 40.0, "end": 80.0}, {**MINUTE, "begin": 10.0, "end": 30.0}]
    rows = [row(missing=usual), row(missing=parted, partitions=cuts)]
    assert with_network_costs(rows)[1]["healed_after"] == 20
    between = [{**MINUTE, "begin": 45.0, "end": 55.0}]  # no sample lies in it
    assert with_network_costs([rows[0], {**rows[1], "partitions": between}])[1]["healed_after"] is None


def test_rows_differ_in_the_fields_of_a_variant_alone() -> None:
    rows = [row(0), row(1, wire_bytes=9), row(0, loss=0.1, partitions=[MINUTE])]
    assert differing(rows) == ["loss", "partitions"]
    assert differing(rows, without=["loss"]) == ["partitions"]
    assert differing(rows[:2]) == differing([]) == []
    assert variant_of(rows[0]) == variant_of(rows[1]) != variant_of(rows[2])
    assert len(variant_of(rows[0], without=["loss"])) == len(VARIANT) - 1
    assert variant_of(rows[2], ["loss"]) == (0.1,)
