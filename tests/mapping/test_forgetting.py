"""Maps that follow a changing world: doors that open, people who walk, and worlds that stay as they are."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gmmtorch import GaussianMap, IncrementalRule, Scan, WindowedRule
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.simulation import World2D, laser_2d, simulate_scan
from gmmtorch.team.sharing import Replica

RULES = {
    "incremental": IncrementalRule(window=8),
    "bytes": IncrementalRule(window=8, max_bytes=900),
    "windowed": WindowedRule(window=8),
    "per_scan": WindowedRule(window=1, max_origins=1),
}
ROOM = [((0, 0), (8, 0)), ((8, 0), (8, 6)), ((8, 6), (0, 6)), ((0, 6), (0, 0))]
WALL = [((4, 0), (4, 2)), ((4, 4), (4, 6))]
DOOR = [((4, 2), (4, 4))]
SENSOR = laser_2d(n_beams=360, field_of_view=2 * math.pi)


def seen(segments: list, x: float, y: float = 2.5, seed: int = 0, **options: float) -> Scan:
    """The scan of line segments from (x, y)."""
    pose = torch.eye(3, dtype=torch.float64)
    pose[:2, 2] = torch.tensor([x, y])
    world = World2D(torch.tensor(segments, dtype=torch.float64), torch.zeros(0, 2))
    scan = simulate_scan(SENSOR, pose, world, torch.Generator().manual_seed(seed))
    return replace(scan, **options)


def person(x: float, y: float) -> list:
    corners = [(x + 0.2, y + 0.2), (x - 0.2, y + 0.2), (x - 0.2, y - 0.2), (x + 0.2, y - 0.2)]
    return list(zip(corners, corners[1:] + corners[:1], strict=True))


def mapped(scans: list[Scan], rule: str, forget: str | float = "contradiction", **options) -> GaussianMap:
    made = GaussianMap(replace(RULES[rule], forget=forget), **options)
    for scan in scans:
        made.insert(scan)
    return made


def door_opens() -> list[Scan]:
    """Twenty scans with the door closed, then twenty with the door open."""
    closed = [seen(ROOM + WALL + DOOR, 1 + 0.05 * n, seed=n, time=n) for n in range(20)]
    return closed + [seen(ROOM + WALL, 2 - 0.05 * n, seed=50 + n, time=20 + n) for n in range(20)]


def on(segments: list, step: float = 0.1) -> Tensor:
    """Points along segments."""
    ends = torch.tensor(segments, dtype=torch.float64)
    share = torch.arange(step, 1 - step / 2, step, dtype=torch.float64)[:, None, None]
    return (ends[:, 0] + share * (ends[:, 1] - ends[:, 0])).flatten(0, 1)


@pytest.mark.parametrize("rule", RULES)
def test_a_door_that_opens_is_open_and_its_wall_stays(rule):
    scans = door_opens()
    kept, forgot = mapped(scans, rule, "off"), mapped(scans, rule)
    door = torch.tensor([[4.0, 2.85], [4.0, 3.0], [4.0, 3.3]])
    assert bool((kept.occupancy(door) > 0.5).all())
    assert bool((forgot.occupancy(door) < 0.5).all())
    walls = on(WALL, 0.2)
    assert bool(
        (forgot.occupancy(walls) > 0.5).double().mean() >= (kept.occupancy(walls) > 0.5).double().mean()
    )
    if rule == "bytes":
        assert forgot.nbytes <= 900


@pytest.mark.parametrize("rule", ["incremental", "windowed", "per_scan"])
def test_a_person_who_walks_leaves_no_trail(rule):
    ways = [(2.5, 0.8 + 0.05 * n) for n in range(60)]
    scans = [seen(ROOM + person(*way), 6.0, seed=n) for n, way in enumerate(ways)]
    scans += [seen(ROOM, 6.0, seed=90 + n) for n in range(10)]
    trail = torch.tensor(ways)[2:-2] + torch.tensor([0.2, 0.0])  # the side that the sensor saw
    kept, forgot = mapped(scans, rule, "off"), mapped(scans, rule)
    assert float((kept.occupancy(trail) > 0.5).double().mean()) > 0.2
    assert not bool((forgot.occupancy(trail) > 0.5).any())
    assert bool((forgot.occupancy(on(ROOM)) > 0.5).double().mean() > 0.95)


@settings(max_examples=6, deadline=None)
@given(seed=st.integers(0, 1000), rule=st.sampled_from(["incremental", "windowed", "per_scan"]))
def test_a_world_that_stays_is_not_eroded(seed, rule):
    generator = torch.Generator().manual_seed(seed)
    place = 1 + torch.rand(4, 2, generator=generator) * torch.tensor([6.0, 4.0])
    poles = [side for x, y in place.tolist() for side in person(x, y)]
    way = 0.5 + 7 * torch.rand(24, generator=generator).sort().values
    scans = [seen(ROOM + poles, float(x), 0.4, seed=n) for n, x in enumerate(way)]
    kept, forgot = mapped(scans, rule, "off"), mapped(scans, rule)
    assert forgot.n_components >= 0.99 * kept.n_components
    found = [made.occupancy(on(ROOM + poles)) > 0.5 for made in (kept, forgot)]
    assert float((found[0] & ~found[1]).double().mean()) < 0.01


def test_a_surface_that_comes_back_is_learned_again():
    scans = [*door_opens(), *(seen(ROOM + WALL + DOOR, 1 + 0.05 * n, seed=99 + n) for n in range(8))]
    assert float(mapped(scans, "incremental").occupancy(torch.tensor([[4.0, 3.0]]))) > 0.5


def test_returns_end_a_doubt():
    closed, opened = ROOM + WALL + DOOR, ROOM + WALL
    first = [seen(closed, 1 + 0.05 * n, seed=n) for n in range(6)]
    some = [seen(opened, 1.0, seed=50 + n) for n in range(3)]  # too few to be sure
    made = mapped(first + some, "per_scan")
    doubted = made._doubts
    assert len(doubted.ids) > 0
    made.insert(seen(closed, 1.0, seed=60))
    assert float(made._doubts.log_odds.sum()) < 0.5 * float(doubted.log_odds.sum())


def test_queries_between_scans_change_nothing():
    scans = door_opens()
    asked = GaussianMap(replace(RULES["windowed"], forget="contradiction"))
    for scan in scans:
        asked.insert(scan)
        assert asked.n_components > 0
    torch.testing.assert_close(asked.means, mapped(scans, "windowed").means, rtol=0, atol=0)


@pytest.mark.parametrize(("rule", "forget"), [("per_scan", "contradiction"), ("windowed", 20.0)])
def test_a_restored_map_forgets_as_the_map_that_was_saved(rule, forget, tmp_path):
    scans = door_opens()
    whole, first = mapped(scans, rule, forget), mapped(scans[:27], rule, forget)
    torch.save(first.state_dict(), tmp_path / "state.pt")
    restored = GaussianMap()
    restored.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    for scan in scans[27:]:
        restored.insert(scan)
    assert torch.equal(restored.support, whole.support)
    assert torch.equal(restored.ids, whole.ids)


def test_a_damaged_state_of_doubts_is_an_error():
    made = mapped(door_opens(), "per_scan")
    state = made.state_dict()
    state["_extra_state"]["doubts"]["log_odds"] = torch.zeros(1)
    with pytest.raises(DataError, match="doubt"):
        GaussianMap().load_state_dict(state)


def test_a_half_life_fades_evidence_by_the_times_of_scans():
    scans = [seen(ROOM, 2.0, seed=n, time=100.0 + n) for n in range(4)]
    later = seen(ROOM, 6.0, seed=9, time=103.0 + 3 * 30.0)
    made = mapped(scans, "per_scan", 30.0, codec="float")
    total, ids = float(made.support.sum()), made.ids
    made.insert(later)
    old = made.components().has_id(ids)
    lost = total / 8 - float(made.support[old].sum())
    assert -1e-9 <= lost < 0.5 * len(ids)  # components below half a point are dropped
    torch.testing.assert_close(made.components().support[old].sum(), made.seen_count[old[made.seen_by]].sum())


def test_old_components_are_dropped_and_clocks_that_jump_back_add_nothing():
    made = mapped([seen(ROOM, 2.0, time=0.0)], "per_scan", 1.0)
    made.insert(seen(ROOM, 2.0, time=60.0))
    assert int(made.ids[:, 1].min()) > 0
    support = float(made.support.sum())
    made.insert(replace(seen(ROOM, 2.0, time=-60.0)).select(torch.zeros(360, dtype=torch.bool)))
    assert float(made.support.sum()) == support


def test_a_file_holds_the_time_from_which_a_half_life_continues(tmp_path):
    scans = [seen(ROOM, 2.0, seed=n, time=1e9 + 10 * n) for n in range(3)]
    made = mapped(scans[:2], "per_scan", 10.0, codec="float")
    made.save(tmp_path / "map.safetensors")
    loaded = GaussianMap.load(tmp_path / "map.safetensors")
    for one in (made, loaded):
        one.insert(scans[2])
    torch.testing.assert_close(loaded.support, made.support, rtol=0, atol=0)


def test_replicas_supersede_what_a_map_forgets():
    made = GaussianMap(replace(RULES["windowed"], forget="contradiction"), robot=1)
    first, second = Replica(1), Replica(2)
    for number, scan in enumerate(door_opens()):
        made.insert(scan)
        if number % 8 == 7 or number == 39:
            first.add(made)
            for datagram in first.datagrams():
                assert second.receive(datagram)
    assert second.n_components == made.n_components
    assert float(second.map().occupancy(torch.tensor([[4.0, 3.0]]))) < 0.5


def test_a_half_life_needs_times():
    with pytest.raises(InvalidArgumentError, match=r"has no time.*time=seconds"):
        mapped([seen(ROOM, 2.0)], "per_scan", 10.0)


def test_depth_images_contradict():
    depth, near = torch.full((24, 32), 4.0), torch.full((24, 32), 4.0)
    near[8:16, 8:20] = 2.0
    intrinsics, pose = torch.tensor([[30.0, 0, 16], [0, 30.0, 12], [0, 0, 1]]), torch.eye(4)
    made = GaussianMap(IncrementalRule(forget="contradiction"))
    made.insert_depth([(near, pose)] * 8, intrinsics, 1)
    assert float(made.occupancy(torch.tensor([[0.0, 0.0, 2.0]]))) > 0.5
    made.insert_depth([(depth, pose)] * 8, intrinsics, 1)
    assert float(made.occupancy(torch.tensor([[0.0, 0.0, 2.0]]))) < 0.5


def test_no_components_and_no_beams_are_no_error():
    empty = Scan(torch.zeros(0, 2), torch.zeros(2))
    assert mapped([empty, empty], "per_scan").n_components == 0
    assert mapped([empty, seen(ROOM, 2.0), empty], "per_scan").n_components > 0
