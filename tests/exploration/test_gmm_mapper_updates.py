"""GmmMapper: updates of the thesis's E0, counts, supersessions and corrections of held components."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from exploration.mapped_room import (
    BOX,
    NOVELTY,
    PLACES,
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

from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.novelty import beam_novelty
from gmmtorch.occupancy.voxels.boxes import Box
from gmmtorch.simulation.sensors.depth_camera import DepthFrame
from gmmtorch.team.exploration.robot.gmm_mapper import GmmMapper
from gmmtorch.team.exploration.robot.mapper import Memo
from gmmtorch.team.sharing.messages.message_registry import (
    CountsMessage,
    decode,
    encode_counts,
)
from gmmtorch.team.sharing.replica.replica import Replica


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
    everywhere = Box(torch.tensor([-(10**7)] * 3), torch.tensor([10**7] * 3))
    tiled = listener.tiles.near(everywhere, 0.2)
    assert sum(map(len, tiled)) == len(listener.components())


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


def test_a_map_learns_again_after_all_is_superseded() -> None:
    speaker, listener = speaker_and_listener(Memo(256))
    replica_of(speaker).add(Components.empty(3), supersedes=speaker.components().ids)
    listener.receive(heard(*speaker.shared.datagrams()))
    assert len(listener.components()) == 0
    assert float(torch.stack(listener.belief.grid.dense(BOX)).sum()) == 0
    assert listener.belief.entropy_bits == listener.belief.observable_bits
    sensed = listener.sense(frame(*PLACES[0]))
    assert bool(sensed.novel.all())
    assert_same_evidence(listener, rebuilt(listener))


def test_the_evidence_cache_distinguishes_all_values_of_a_batch() -> None:
    memo, one = Memo(8), first_batch()[0]
    held = one.components()
    moved = replace(held, means=held.means + 0.3, origins=held.origins + 0.3)
    found = []
    for batch in (held, moved):
        other = mapper(codec="float", memo=memo)
        other._enter(batch)
        found.append(torch.stack(other.belief.grid.dense(BOX)))
    assert not torch.equal(*found)
