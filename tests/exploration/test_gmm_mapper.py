"""GmmMapper: the sender and all receivers hold the same map."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable

import pytest
import torch
from exploration.mapped_room import (
    BOX,
    HIGH,
    LOW,
    NOVELTY,
    PLACES,
    assert_same_components,
    assert_same_evidence,
    by_kind,
    counts_in,
    first_batch,
    frame,
    heard,
    mapper,
    rebuilt,
    thesis_mapper,
)
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.association import count_explained
from gmmtorch.occupancy.voxels.boxes import intersection
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.simulation.sensors.depth_camera import DepthFrame
from gmmtorch.team.exploration.robot.gmm_mapper import FrameRule, GmmMapper
from gmmtorch.team.exploration.robot.mapper import FrameUpdate
from gmmtorch.team.sharing.messages.message_registry import (
    ComponentsMessage,
    CountsMessage,
    decode,
    encode_components,
    encode_plan,
    encode_points,
)

Flight = tuple[GmmMapper, list[FrameUpdate], list[bytes]]


def recorded_flight(codec: str = "replica", robot: int = 0) -> Flight:
    """A mapper after three visits to each place, so that it has counts to send; its updates and datagrams."""
    one = mapper(robot, codec)
    sensed, said = [], []
    for seed, place in itertools.product(range(3), PLACES):
        sensed.append(one.sense(frame(*place, seed=seed)))
        said += one.shared.datagrams()
    return one, sensed, said


@pytest.fixture(scope="module")
def flight() -> Flight:
    return recorded_flight()


@pytest.fixture(scope="module")
def broadcast_flight() -> Flight:
    return recorded_flight("quantized")


# -- what is sent ----------------------------------------------------------------------------------


def test_sent_components_equal_held_components(broadcast_flight: tuple) -> None:
    one, _, said = broadcast_flight
    components, counts = by_kind(said)
    assert counts
    total = counts_in(components, counts)
    held = one.components().checked()
    assert [tuple(key) for key in held.ids.tolist()] == sorted(total)
    assert held.ids[:, 0].unique().tolist() == [0]
    assert held.ids[:, 1].tolist() == list(range(len(held)))
    assert held.support.tolist() == pytest.approx([total[key] for key in sorted(total)])
    decoded = [decode(data) for data in components]
    parts = Components.concatenate([m.components for m in decoded if isinstance(m, ComponentsMessage)])
    assert torch.equal(held.means, parts.means[parts.ids[:, 1].argsort()])
    assert torch.equal(held.covariances, parts.covariances[parts.ids[:, 1].argsort()])
    assert held.max_range.unique().tolist() == [False, True]


@pytest.mark.parametrize("codec", ["replica", "quantized"])
def test_voxels_equal_those_cast_from_the_mixture(codec: str, flight: tuple, broadcast_flight: tuple) -> None:
    one = {"replica": flight, "quantized": broadcast_flight}[codec][0]
    assert_same_evidence(one, rebuilt(one))


WAYPOINTS = [(1.5, 3.0), (2.5, 3.2), (4.0, 3.5), (5.5, 3.0), (6.8, 2.0), (5.0, 2.5), (3.0, 4.0), (1.5, 5.0)]


def test_a_moving_window_equals_the_belief() -> None:
    """The belief adds all evidence as it arrives, and never moves."""
    one = mapper()
    one.local = RollingWindow(0.2, (20, 20, 12), step=4)
    one.center_on(torch.tensor([*WAYPOINTS[0], 1.4], dtype=torch.float64))
    refilled = 0.0
    for turn, place in enumerate(WAYPOINTS):
        before = one.local.box.low
        one.center_on(torch.tensor([*place, 1.4], dtype=torch.float64))
        found = torch.stack(one.local.evidence())
        moved = (before - one.local.box.low).tolist()
        kept = torch.zeros(one.local.shape, dtype=torch.bool)
        spans = [slice(max(0, m), n + min(0, m)) for m, n in zip(moved, kept.shape, strict=True)]
        kept[tuple(spans)] = True
        refilled += float(found[:, ~kept].sum())
        assert_window_is_that_of_the_belief(one)
        one.sense(frame((*place, 1.4), 1.3 * turn, seed=turn))
        assert_window_is_that_of_the_belief(one)
    assert refilled > 1000
    assert float(torch.stack(one.belief.grid.dense(BOX)).sum()) > refilled


def assert_window_is_that_of_the_belief(one: GmmMapper) -> None:
    """Compares every cell that is in both."""
    box = intersection(one.local.box, BOX)
    assert box is not None
    inside = tuple(
        slice(low, high)
        for low, high in zip(
            (box.low - one.local.box.low).tolist(), (box.high - one.local.box.low).tolist(), strict=True
        )
    )
    for found, expected in zip(one.local.evidence(), one.belief.grid.dense(box), strict=True):
        torch.testing.assert_close(found[inside], expected, rtol=1e-4, atol=1e-3)


def test_component_support_equals_the_number_of_novel_beams() -> None:
    one = mapper(codec="float")
    view = frame(*PLACES[0])
    sensed = one.sense(view)
    assert bool(sensed.novel.all())  # everything in the first frame is novel
    held = one.components()
    for max_range in (False, True):
        number = int((view.is_hit != max_range).sum())
        assert number > 50
        assert float(held.support[held.max_range == max_range].sum()) == pytest.approx(number)
    # Where they are: at the walls, as far as the camera looks.
    walls = held.means[~held.max_range]
    assert float(torch.minimum(walls - LOW, HIGH - walls).amin(1).abs().max()) < 0.1
    assert held.origins[held.seen_from].unique(dim=0).tolist() == [list(PLACES[0][0])]


def test_the_order_of_messages_does_not_matter(broadcast_flight: tuple) -> None:
    one, _, said = broadcast_flight
    components, counts = by_kind(said)
    generator = torch.Generator().manual_seed(0)

    def shuffled(datagrams: list[bytes]) -> list[bytes]:
        return [datagrams[i] for i in torch.randperm(len(datagrams), generator=generator).tolist()]

    other = mapper(1, "quantized")
    other.receive(heard(*shuffled(components), *shuffled(counts)))
    assert len(components) > 3
    assert counts
    assert_same_components(one.components(), other.components(), exact=False)
    assert_same_evidence(one, other)


@pytest.mark.parametrize("codec", ["replica", "quantized"])
def test_sense_returns_the_evidence_it_adds(codec: str, flight: tuple, broadcast_flight: tuple) -> None:
    one, sensed, _ = {"replica": flight, "quantized": broadcast_flight}[codec]
    hits, misses = torch.zeros(BOX.shape), torch.zeros(BOX.shape)
    for part in itertools.chain(*(s.evidence for s in sensed)):
        inside = ((part.cells >= BOX.low) & (part.cells < BOX.high)).all(1)
        at = part.cells[inside].unbind(1)
        hits[at] += part.hits[inside]
        misses[at] += part.misses[inside]
    found = one.belief.grid.dense(BOX)
    torch.testing.assert_close(found[0], hits, rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(found[1], misses, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("make", [mapper, thesis_mapper])
def test_two_robots_that_exchange_messages_hold_the_same_map(make: Callable[[int], GmmMapper]) -> None:
    pair = [make(robot) for robot in range(2)]
    for turn, place in enumerate(PLACES * 5):  # so often that each has counts to tell
        speaker, listener = pair[turn % 2], pair[1 - turn % 2]
        speaker.sense(frame(*place, seed=turn))
        listener.receive(heard(*speaker.shared.datagrams(), sender=turn % 2))
    assert pair[0].shared.digest() == pair[1].shared.digest()
    assert pair[0].components().ids[:, 0].unique().tolist() == [0, 1]
    assert_same_components(pair[0].components(), pair[1].components(), exact=False)
    assert_same_evidence(*pair)


# -- repeated frames -------------------------------------------------------------------------------


def test_frames_of_a_known_place_are_sent_as_counts() -> None:
    one = mapper(codec="quantized")
    sensed, told, counts = [], [], []
    for seed in range(10):
        sensed.append(one.sense(frame(*PLACES[0], seed=seed)))
        new, gained = by_kind(one.shared.datagrams())
        told.append(counts_in(new, []))
        counts.append(gained)
    first, *again = sensed
    assert bool(first.novel.all())
    assert counts[0] == []
    for later, components in zip(again[2:], told[3:], strict=True):
        assert float(later.novel.double().mean()) < 0.1
        assert len(components) < 0.5 * len(told[0])
        assert sum(components.values()) < 0.1 * sum(told[0].values())
    assert any(counts)


@pytest.mark.parametrize("update_at", [1.5, 2.0, 4.0])
def test_counts_are_sent_once_they_have_grown_enough(update_at: float) -> None:
    """Counts computed here are sent, except those that have not grown enough."""
    one = mapper(codec="float", update_at=update_at, update_stride=1)
    explained: Counter[tuple[int, int]] = Counter()
    sent: Counter[tuple[int, int]] = Counter()
    for seed in range(20):
        view = frame(*PLACES[0], seed=seed)
        before = counted = one.components()
        sensed = one.sense(view)
        for max_range in (False, True) if len(before) else ():
            ends = view.ends[~sensed.novel & (view.is_hit != max_range)]
            counted = count_explained(
                counted, ends, view.origin, NOVELTY.distance, max_range=max_range
            ).components
        ids = [tuple(key) for key in before.ids.tolist()]
        supports = dict(zip(ids, before.support.tolist(), strict=True))
        explained.update(dict(zip(ids, (counted.support - before.support).tolist(), strict=True)))
        for message in map(decode, by_kind(one.shared.datagrams())[1]):
            assert isinstance(message, CountsMessage)
            assert message.sender == 0
            for key, count in message.counts.items():
                assert count >= (update_at - 1) * supports[key] * (1 - 1e-9)
            sent.update(message.counts)
        for key, total in explained.items() if seed % 10 == 9 else ():  # all due counts have been sent
            owed = total - sent[key]
            assert owed < (update_at - 1) * supports[key] * (1 + 1e-9) or owed == pytest.approx(0, abs=1e-6)
    assert sent


def test_a_stride_weights_the_beams_it_uses() -> None:
    gains = []
    for stride in (1, 4):
        one = mapper(codec="float", update_at=1.0 + 1e-9, update_stride=stride)  # sends all counts
        for seed in range(10):  # counts are sent every ten frames
            one.sense(frame(*PLACES[0], seed=seed))
        messages = [decode(datagram) for datagram in by_kind(one.shared.datagrams())[1]]
        counts = [sum(m.counts.values()) for m in messages if isinstance(m, CountsMessage)]
        gains.append(sum(counts))
    assert gains[0] > 300
    assert gains[1] == pytest.approx(gains[0], rel=0.1)


# -- edges -----------------------------------------------------------------------------------------


def test_messages_of_other_kinds_are_ignored() -> None:
    one, _ = first_batch()
    held, entropy = one.components(), one.belief.entropy_bits
    ends = torch.ones(5, 3, dtype=torch.float64)
    origin = torch.zeros(3, dtype=torch.float64)
    others = encode_points(2, 0, origin, ends, torch.ones(5, dtype=torch.bool))
    poses = torch.tensor([[1.0, 1.0, 1.0, 0.0]], dtype=torch.float64)
    others += encode_plan(2, 0, 1.0, 0.2, poses)
    assert one.receive(heard(*others, sender=2)) == []
    assert_same_components(held, one.components())
    assert one.belief.entropy_bits == entropy


def part_of(view: DepthFrame, chosen: Tensor) -> DepthFrame:
    return DepthFrame(view.origin, view.ends[chosen], view.is_hit[chosen], view.pixel[chosen])


def test_a_frame_without_beams_sends_nothing() -> None:
    view = frame(*PLACES[0])
    nothing = part_of(view, torch.zeros(0, dtype=torch.int64))
    fresh = mapper()
    for one in (fresh, first_batch()[0]):
        held, entropy = one.components(), one.belief.entropy_bits
        one.shared.datagrams()
        sensed = one.sense(nothing)
        assert one.shared.datagrams() == []
        assert sensed.novel.shape == (0,)
        assert sum(float(p.hits.sum() + p.misses.sum()) for p in sensed.evidence) == 0
        assert len(one.components()) == len(held)
        assert one.belief.entropy_bits == entropy
    assert len(fresh.components()) == 0
    assert float(fresh.sense(view).novel.double().mean()) == 1


@pytest.mark.parametrize("hits", [False, True])
def test_frames_with_only_returns_or_only_no_returns(hits: bool) -> None:
    view = frame(*PLACES[0])
    one = mapper(codec="float")
    sensed = one.sense(part_of(view, (view.is_hit == hits).nonzero().squeeze(1)))
    held = one.components()
    assert len(held) > 0
    assert bool((held.max_range != hits).all())
    found, misses = one.belief.grid.dense(BOX)
    assert (float(found.sum()) > 0) == hits
    assert float(misses.sum()) > 100
    assert bool(sensed.novel.all())


def test_invalid_frame_rules_are_rejected() -> None:
    for options, message in (
        ({"noise": 0.0}, "noise=0"),
        ({"length": -1.0}, "length=-1"),
        ({"cell": float("nan")}, "cell=nan"),
        ({"rays": 0.0}, "rays=0"),
        ({"shell": -1.0}, "shell=-1"),
        ({"components": 0}, "components=0"),
        ({"update_stride": 0}, "update_stride=0"),
        ({"update_at": 0.9}, "update_at=0.9"),
        ({"update_every": 0}, "update_every=0"),
        ({"novelty_block": 0}, "novelty_block=0"),
        ({"hits_per_ray": 0}, "hits_per_ray=0"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            FrameRule(**options)
    assert encode_components(Components.empty(3)) == []
