"""GmmMapper: sender and receivers hold the same map, also after counts, supersessions and corrections."""

from __future__ import annotations

import itertools
from collections import Counter

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
from scipy.stats import chi2
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping import Components, all_origins, beam_novelty, count_explained, fit_window
from gmmtorch.occupancy import RollingWindow, intersection
from gmmtorch.scan import Scan
from gmmtorch.simulation.robot_camera import DepthFrame
from gmmtorch.team.exploration.mission.options import FrameRule
from gmmtorch.team.exploration.robot.mapper import FrameUpdate, GmmMapper, Memo
from gmmtorch.team.sharing import Replica, decode
from gmmtorch.team.sharing.messages.component_messages import (
    ComponentsMessage,
    CountsMessage,
    encode_components,
    encode_counts,
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


def test_the_order_of_messages_does_not_matter(broadcast_flight: tuple, generator: torch.Generator) -> None:
    one, _, said = broadcast_flight
    components, counts = by_kind(said)

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


def test_surfaces_are_as_exact_as_an_octree_of_the_side_and_coarser_ones_take_fewer_components() -> None:
    ways = torch.randn(20_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sphere = Scan(2.0 * ways / ways.norm(dim=1, keepdim=True), torch.zeros(3, dtype=torch.float64))
    sizes = []
    for side in (0.05, 0.1, 0.2, 0.6):
        rule = FrameRule(side=side, length=3.0, cell=0.05)
        found = fit_window([sphere], rule.surface_fit(), all_origins())
        thickness = torch.linalg.eigvalsh(found.covariances)[:, 0].sqrt()
        assert float(thickness.quantile(0.9)) < side / 2 + 0.03  # and the noise of the sensor
        cells = (sphere.points / side).floor()
        off = (sphere.points - (cells + 0.5) * side).norm(dim=1)
        assert float(off.square().mean().sqrt()) == pytest.approx(side / 2, rel=0.1)  # of an octree
        sizes.append(len(found))
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[0] > 2 * sizes[-1]


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
        assert float(later.novel.double().mean()) < 0.12
        assert len(components) < 0.5 * len(told[0])
        assert sum(components.values()) < 0.12 * sum(told[0].values())
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
            counted, _ = count_explained(counted, ends, view.origin, NOVELTY.distance, max_range=max_range)
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
        ({"side": 0.0}, "side=0"),
        ({"side": float("nan")}, "side=nan"),
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


def replica_of(one: GmmMapper) -> Replica:
    assert isinstance(one.shared, Replica)
    return one.shared


# -- E0 of the thesis ------------------------------------------------------------------------------


def explained_by_a_loop(one: GmmMapper, seen: DepthFrame) -> tuple[Tensor, dict[tuple[int, int], float]]:
    """Which novel beams of a frame components explain, and what these gain (thesis 4.1.3)."""
    known, limit = one.components(), float(chi2.ppf(0.95, 3))
    near = (known.origins[known.seen_from] - seen.origin).norm(dim=1) <= one._novelty.distance
    novel, ends_here = (
        (unobserved | (bits >= NOVELTY.threshold))
        for bits, unobserved in (
            beam_novelty(one.local, seen.origin, seen.ends, hits, NOVELTY, within=BOX)
            for hits in (seen.is_hit, torch.zeros_like(seen.is_hit))
        )
    )
    gains: dict[tuple[int, int], float] = {}
    explained = torch.zeros_like(novel)
    for n in novel.nonzero().squeeze(1).tolist():
        offset = seen.ends[n] - known.means
        squared = (offset[:, None] @ torch.linalg.inv(known.covariances) @ offset[..., None]).flatten()
        valid = (squared < limit) & (known.max_range != seen.is_hit[n])
        if ends_here[n] or not seen.is_hit[n]:
            valid &= near
        rows = valid.nonzero().squeeze(1).tolist()
        explained[n] = bool(rows)
        for row in rows:
            key = tuple(known.ids[row].tolist())
            gains[key] = gains.get(key, 0.0) + float(squared[row] ** -1 / (squared[rows] ** -1).sum())
    return explained, gains


def test_in_the_thesis_novel_points_update_the_components_that_explain_them() -> None:
    one = thesis_mapper()
    sizes, n_explained = [], 0
    for seed, place in enumerate([*PLACES, *PLACES]):
        seen = frame(*place, seed=seed)
        explained, gains = explained_by_a_loop(one, seen)
        novel = one.sense(seen).novel
        assert bool(novel[explained].all())
        components, counts = by_kind(one.shared.datagrams())
        learned = sum(counts_in(components, []).values())
        assert learned == pytest.approx(int((novel & ~explained).sum()), rel=1e-5)  # others are discarded
        told: dict[tuple[int, int], float] = {}
        for message in map(decode, counts):
            assert isinstance(message, CountsMessage)
            told |= message.counts
        assert told == pytest.approx(gains, rel=1e-5)
        sizes += [(len(data) - 5, 57) for data in components] + [(len(data) - 6, 8) for data in counts]
        n_explained += int(explained.sum())
    assert n_explained > 300
    assert all(size % of_a_record == 0 for size, of_a_record in sizes)  # beside kind, sender and checksum
    assert {record for _, record in sizes} == {57, 8}


# -- counts ----------------------------------------------------------------------------------------


def test_counts_scale_evidence_in_proportion() -> None:
    one, components = first_batch()
    held = one.components()
    before = [part.clone() for part in one.belief.grid.dense(BOX)]
    doubled = {tuple(key): s for key, s in zip(held.ids.tolist(), held.support.tolist(), strict=True)}
    one.receive(heard(*encode_counts(1, doubled, "float"), sender=1))
    torch.testing.assert_close(one.components().support, 2 * held.support)
    for a, b in zip(before, one.belief.grid.dense(BOX), strict=True):
        torch.testing.assert_close(b, 2 * a, rtol=1e-5, atol=1e-4)
    assert len(components) > 1  # across datagrams


def test_counts_of_two_robots_with_the_same_sequence_are_told_apart() -> None:
    """Two listeners that each know one of two components that a message counts."""
    memo = Memo(64)
    spoken = []
    for robot, place in enumerate((PLACES[0], PLACES[2])):
        speaker = mapper(robot, "float")
        speaker.sense(frame(*place))
        spoken.append(speaker.shared.datagrams())
    (datagram,) = encode_counts(2, {(0, 0): 50.0, (1, 0): 50.0}, "float")
    found = []
    for shared in (True, False):
        listeners = [mapper(3 + n, "float") for n in range(2)]
        for listener, components in zip(listeners, spoken, strict=True):
            if shared:
                listener._memo = memo
            listener.receive(heard(*components, datagram))
        found.append([torch.stack(listener.belief.grid.dense(BOX)) for listener in listeners])
    for together, alone in zip(*found, strict=True):
        torch.testing.assert_close(together, alone)


# -- supersessions and corrections -----------------------------------------------------------------


def speaker_and_listener(memo: Memo) -> tuple[GmmMapper, GmmMapper]:
    """A mapper that has seen two places, and a listener; they share a cache."""
    speaker, listener = (mapper(robot, memo=memo) for robot in range(2))
    for place in PLACES[:2]:
        speaker.sense(frame(*place))
    listener.receive(heard(*speaker.shared.datagrams()))
    return speaker, listener


def test_superseded_components_leave_the_voxels() -> None:
    speaker, listener = speaker_and_listener(Memo(256))
    before = listener.components()
    old, kept = before.ids[:30], before.ids[30:]
    listener.sense(frame(*PLACES[2]))  # its own stays
    n_own = len(listener.components()) - len(before)
    new = replica_of(speaker).add(before.selected(torch.arange(3)), supersedes=old)
    listener.receive(heard(*speaker.shared.datagrams()))
    assert torch.equal(listener.components().ids[: len(kept) + 3], torch.cat([kept, new]))
    assert len(listener.components()) == len(kept) + 3 + n_own > len(kept) + 3
    assert_same_evidence(listener, rebuilt(listener))
    speaker.receive(heard(*listener.shared.datagrams(), sender=1))
    assert speaker.shared.digest() == listener.shared.digest()
    assert_same_evidence(speaker, rebuilt(listener))
    everywhere = torch.full((3,), 1e6, dtype=torch.float64)
    for boxes in (listener._by_rays, listener._by_explained):
        assert sum(map(len, boxes.near(-everywhere, everywhere))) == len(listener.components())
        assert boxes.near(everywhere, 2 * everywhere) == []


def test_corrected_components_move_in_the_voxels() -> None:
    speaker, listener = speaker_and_listener(Memo(256))
    ids = speaker.components().ids[:40]
    found = []
    for metres in (0.0, 0.4, 1.0):  # repeatedly, with the same ids and support
        transform = torch.eye(4, dtype=torch.float64)
        transform[0, 3] = metres
        replica_of(speaker).correct(7, transform, ids)
        listener.receive(heard(*speaker.shared.datagrams()))
        assert_same_evidence(listener, rebuilt(listener))
        found.append(torch.stack(listener.belief.grid.dense(BOX)))
    assert not torch.equal(found[0], found[1])
    assert not torch.equal(found[1], found[2])
    far = torch.tensor([9.0, 6.0, 1.5], dtype=torch.float64)
    other = rebuilt(listener)
    for each in (listener, other):  # the window is filled from what holds now
        each.center_on(far)
    for a, b in zip(listener.local.evidence(), other.local.evidence(), strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-4)
