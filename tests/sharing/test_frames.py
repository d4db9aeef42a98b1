"""Replica.changes, and frames of robots: in any order of datagrams they give the map."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import random_components
from sharing.message_examples import sealed
from sharing.replica_histories import Follower, exchange, motion, replica_of, rows, told, told_twice
from sharing.schedules import act, components

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.team.sharing.messages.datagrams import pose_of
from gmmtorch.team.sharing.messages.message_registry import decode, kind_of
from gmmtorch.team.sharing.messages.record_messages import (
    CountersMessage,
    FrameMessage,
    SupersessionMessage,
    encode_record,
)
from gmmtorch.team.sharing.replica import authorship
from gmmtorch.team.sharing.replica.record_keys import WORLD, Intervals, first_key
from gmmtorch.team.sharing.replica.replica import Replica

seeds = st.integers(0, 10**6)


def growth(seed: int, n_acts: int = 14) -> list[bytes]:
    """All datagrams of three robots that add and count, and rewrite counters as soon as possible."""

    def grow(rng: random.Random, robot: Replica) -> None:
        known = robot.components().ids.tolist()
        if not known or rng.random() < 0.4:
            robot.add(components(rng, rng.randint(1, 5)))
        else:
            chosen = rng.sample(known, rng.randint(1, min(4, len(known))))
            robot.count({tuple(row): rng.uniform(0.0, 500.0) for row in chosen})

    rng = random.Random(seed)
    robots = [Replica(robot, incarnation=rng.getrandbits(24)) for robot in range(3)]
    return told(rng, robots, n_acts, grow)


@settings(max_examples=5, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_added_and_gained_components_are_the_map(seed, order):
    """For any order, loss and repetition of datagrams, and any number of reads."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(authorship, "_MOST_OUTDATED", 1)
        patch.setattr(authorship, "_MOST_SHORT", 2)
        said = growth(seed)
    heard = [datagram for datagram in said if order.random() < 0.9]
    heard += order.sample(heard, len(heard) // 3)
    order.shuffle(heard)
    replica, follower = Replica(9), Follower()
    for datagram in heard:
        assert replica.receive(datagram)
        if order.random() < 0.3:
            follower.follow(replica)
            assert follower.agrees(replica)
    follower.follow(replica)
    assert follower.agrees(replica)
    assert not follower.rebuilt  # rewritten counters do not change the map
    nothing = replica.changes()
    assert (nothing.added, len(nothing.gained), nothing.rebuilt) == ([], 0, False)


@settings(max_examples=4, deadline=None)
@given(seed=seeds)
def test_a_follower_that_rebuilds_has_the_map(seed):
    rng = random.Random(seed)
    robots, followers = [Replica(robot, incarnation=robot) for robot in range(2)], [Follower(), Follower()]
    late: list[bytes] = []
    for _ in range(20):
        which = rng.randrange(2)
        act(rng, robots[which])
        late += [datagram for datagram in robots[which].datagrams() for _ in range(rng.choice([0, 1, 1, 2]))]
        rng.shuffle(late)
        for datagram in [late.pop() for _ in range(rng.randint(0, len(late)))]:
            robots[rng.randrange(2)].receive(datagram)
        for replica, follower in zip(robots, followers, strict=True):
            if rng.random() < 0.6:
                follower.follow(replica)
                assert follower.agrees(replica)


def test_components_equal_those_of_datagrams_at_all_robots():
    one, other = Replica(0), Replica(1)
    for seed, k in enumerate((30, 300, 1)):
        one.add(random_components(3, k=k, seed=seed))
    datagrams = one.datagrams()
    for datagram in datagrams:
        other.receive(datagram, decode(datagram))
    heard = other.changes().added
    assert len(heard) == len(datagrams) > 3
    for theirs, datagram in zip(heard, datagrams, strict=True):
        assert_same_components(theirs, decode(datagram).components)
    assert_same_components(one.components(), other.components())


def test_a_component_without_points_gains_them_evenly():
    one = Replica(0)
    bare = random_components(3, k=1, seed=3, n_origins=4, max_sightings=1)
    bare = Components(
        **{
            **vars(bare),
            "support": torch.zeros(1, dtype=torch.float64),
            "seen_by": torch.zeros(2, dtype=torch.int64),
            "seen_from": torch.arange(2),
            "seen_count": torch.zeros(2, dtype=torch.float64),
        }
    )
    name = tuple(one.add(bare)[0].tolist())
    one.count({name: 16.0})
    assert one.changes().gained.seen_count.tolist() == one.components().seen_count.tolist() == [8.0, 8.0]


def test_only_changes_of_known_components_demand_a_rebuild():
    one, follower = Replica(0), Follower()
    ids = one.add(random_components(3, k=4))
    one.add(random_components(3, k=0), supersedes=ids[:1])
    follower.follow(one)
    assert not follower.rebuilt  # these components were not reported yet
    one.add(random_components(3, k=2, seed=1), supersedes=ids[1:2])
    follower.follow(one)
    assert follower.rebuilt == 1
    one.correct(0, motion(2.0), ids[2:])
    follower.follow(one)
    assert follower.rebuilt == 2
    assert follower.agrees(one)
    late = Replica(1)
    late.changes()
    for datagram in one.datagrams():  # components arrive superseded and corrected
        late.receive(datagram)
    assert late.digest() == one.digest()


def test_falling_counters_demand_a_rebuild():
    """A lower count from another robot is accepted, and the follower starts over."""
    one, other, follower = Replica(0), Replica(5, incarnation=2), Follower()
    key = one.add(random_components(3, k=1))[0].tolist()
    other.count({tuple(key): 64.0})
    for datagram in other.datagrams():
        one.receive(datagram)
    follower.follow(one)
    first = 5 << 52 | 2 << 28
    less = CountersMessage(first + 1, np.array([key[1]], np.int64), np.array([8], np.int64))
    assert one.receive(encode_record(less))
    old, new = Intervals.span(first, first + 1), Intervals.span(first + 1, first + 2)
    assert one.receive(encode_record(SupersessionMessage(first + 2, old, new)))
    follower.follow(one)
    assert follower.rebuilt == 1
    assert follower.agrees(one)


def team(n: int) -> list[Replica]:
    return [Replica(robot, incarnation=7, own_frame=True) for robot in range(n)]


def means(replica: Replica, robot: int, frame: int | None = None) -> torch.Tensor:
    """Of the components of a robot, by number."""
    found = replica.components(frame)
    return found.means[found.ids[:, 0] == robot]


def joined_history(
    seed: int, kinds: Sequence[str] = ("add", "join", "join", "correct"), n_acts: int = 16
) -> list[bytes]:
    """All datagrams of robots that add, correct and join each other at random."""

    def act(rng: random.Random, robot: Replica) -> None:
        own = robot.components().ids
        own = own[own[:, 0] == robot.robot]
        kind = rng.choice(kinds)
        if kind == "join" and robot.other_frames:
            robot.join(rng.choice(robot.other_frames), motion(rng.uniform(-9, 9), rng.uniform(-3, 3)))
        elif kind == "correct" and len(own):
            robot.correct(rng.randrange(2), motion(rng.uniform(-1, 1)), own[:2])
        else:
            robot.add(components(rng, 2))

    return told(random.Random(seed), team(3), n_acts, act)


class Model:
    """Where frames are, by plain dictionaries."""

    def __init__(self, said: list[bytes]) -> None:
        self.records: dict[int, FrameMessage] = {}
        frames = [message for one in said if isinstance(message := decode(one), FrameMessage)]
        for message in sorted(frames, key=lambda m: m.version):
            self.records[message.frame] = message

    def placed(self, frame: int) -> tuple[int, torch.Tensor]:
        record = self.records[frame]
        if record.anchor == frame:
            return frame, torch.eye(4, dtype=torch.float64)
        root, before = self.placed(record.anchor)
        shift, (z, w) = record.pose[:3], record.pose[5:].tolist()
        step = motion(0.0, 2 * math.atan2(z, w))
        step[:3, 3] = shift
        return root, before @ step


@settings(max_examples=8, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(seed, order):
    one, other = told_twice(joined_history(seed), order)
    for frame in {one.placement.root, *(7 | robot << 24 for robot in range(3))}:
        assert_same_components(one.components(frame), other.components(frame))


@settings(max_examples=8, deadline=None)
@given(seed=seeds)
def test_components_are_where_a_plain_model_puts_them(seed):
    said = joined_history(seed, ("add", "join"))
    replica, model = replica_of(said), Model(said)
    plain = replica_of([one for one in said if kind_of(one) == "components"])
    raw = rows(plain.components())
    seen = 0
    for frame in (robot << 24 | 7 for robot in range(3)):
        for key, (mean, *_) in rows(replica.components(frame)).items():
            root, pose = model.placed(key >> 28)
            assert root == frame
            expected = pose[:3, :3] @ torch.tensor(raw[key][0], dtype=torch.float64) + pose[:3, 3]
            assert mean == pytest.approx(expected.tolist(), abs=1e-9)
            seen += 1
    assert seen == len(raw)  # each component is in one frame


@settings(max_examples=4, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_a_follower_of_the_changes_has_the_map(seed, order):
    said = joined_history(seed)
    order.shuffle(said)
    replica, follower = Replica(2, incarnation=7), Follower()  # in the frame of robot 2
    for datagram in said:
        replica.load([], [datagram])
        if order.random() < 0.3:
            follower.follow(replica)
            assert follower.agrees(replica)
    follower.follow(replica)
    assert follower.agrees(replica)


def test_frames_without_a_place_are_apart():
    one, other = team(2)
    one.add(random_components(3, k=5))
    other.add(random_components(3, k=4))
    exchange([one, other])
    assert len(one.components()) == 5
    assert len(other.components()) == 4
    assert one.other_frames == []  # the lowest id waits for the others
    assert other.other_frames == [7]
    assert len(other.components(7)) == 5
    assert one.digest() == other.digest()


def test_a_chain_of_frames_follows_its_root_without_sending_components_again():
    robots = team(3)
    for robot in robots:
        robot.add(random_components(3, k=50, seed=robot.robot))
    raw = [means(robot, robot.robot) for robot in robots]
    exchange(robots)
    robots[2].join(1 << 24 | 7, motion(5.0))
    exchange(robots)
    assert robots[1].components().ids[:, 0].unique().tolist() == [1, 2]
    robots[1].join(7, motion(1.0, math.pi / 2))
    sent = robots[1].datagrams()
    assert {kind_of(datagram) for datagram in sent} == {"frames", "supersessions"}
    assert sum(map(len, sent)) < 200
    for robot in (robots[0], robots[2]):
        for datagram in sent:
            robot.receive(datagram)
    for robot in robots:
        assert robot.placement.root == 7
        assert torch.equal(means(robot, 0), raw[0])
        turned = motion(1.0, math.pi / 2)
        assert torch.allclose(means(robot, 1), raw[1] @ turned[:3, :3].T + turned[:3, 3])
        both = turned @ motion(5.0)
        assert torch.allclose(means(robot, 2), raw[2] @ both[:3, :3].T + both[:3, 3])
    # Components that are added later move, too.
    robots[2].add(random_components(3, k=3, seed=9))
    exchange(robots)
    assert len({robot.digest() for robot in robots}) == 1
    assert {len(robot.components()) for robot in robots} == {153}
    one, *others = (robot.components() for robot in robots)
    for other in others:
        assert all(torch.equal(value, getattr(other, name)) for name, value in one.tensors().items())


def test_corrections_apply_in_the_frame_of_their_robot():
    one, other = team(2)
    one.add(random_components(3, k=1))
    ids = other.add(random_components(3, k=2))
    raw = means(other, 1)
    exchange([one, other])
    other.join(7, motion(0.0, math.pi / 2))
    other.correct(0, motion(2.0), ids[ids[:, 1].argsort()][:1])
    exchange([one, other])
    turned = motion(0.0, math.pi / 2)[:3, :3]
    shifted = raw + torch.tensor([[2.0, 0, 0], [0, 0, 0]])
    assert torch.allclose(means(one, 1), shifted @ turned.T)


def test_robots_without_own_frames_are_in_the_world_which_others_join():
    known, unknown = Replica(5), Replica(3, own_frame=True)
    known.add(random_components(3, k=2))
    unknown.add(random_components(3, k=3))
    exchange([known, unknown])
    assert unknown.other_frames == [WORLD]
    assert known.other_frames == []
    unknown.join(WORLD, motion(4.0))
    exchange([known, unknown])
    assert known.placement.root == unknown.placement.root == WORLD
    assert len(known.components()) == len(unknown.components()) == 5


def test_a_restarted_robot_goes_on_in_its_earlier_frame():
    zero, before = team(2)
    zero.add(random_components(3, k=1))
    before.add(random_components(3, k=2))
    old = means(before, 1)
    exchange([zero, before])
    again = Replica(1, incarnation=3, own_frame=True)
    exchange([zero, again])
    earlier = 1 << 24 | 7
    assert again.other_frames == [7, earlier]
    again.join(earlier, torch.eye(4))
    again.add(random_components(3, k=1, seed=5))
    again.join(7, motion(1.0))  # moves the records of both starts
    exchange([zero, again])
    new = means(zero, 1)
    assert len(new) == 3
    assert torch.allclose(new[new[:, 0].argsort()].sum(0), (means(again, 1)).sum(0))
    found = zero.components()
    is_old = (found.ids[:, 0] == 1) & (found.ids[:, 1] >> 28 == 7)
    assert torch.allclose(found.means[is_old], old + torch.tensor([1.0, 0, 0]).double())


def test_robots_join_lower_ids_only():
    robots = team(2)
    robots[1].add(random_components(3, k=1))
    exchange(robots)
    for frame in (1 << 24 | 7, 7, -2):
        with pytest.raises(InvalidArgumentError, match=f"frame={frame}"):
            robots[0].join(frame, torch.eye(4))
    with pytest.raises(InvalidArgumentError, match="rigid"):
        robots[1].join(7, 2 * torch.eye(4))


def test_a_circle_of_frames_places_nothing():
    """No sound robot writes it."""
    replica, pose = Replica(9), pose_of(torch.eye(4))
    frames = [robot << 24 for robot in range(3)]
    for robot, frame in enumerate(frames):
        record = FrameMessage(first_key(robot), frame, 1, frames[(robot + 1) % 3], pose)
        assert replica.receive(encode_record(record))
    for robot in range(3):
        made = random_components(3, k=1)
        source = Replica(robot, incarnation=0)
        source.count({(0, 0): 1.0})  # takes number 0
        source.add(made)
        for datagram in source.datagrams():
            if kind_of(datagram) == "components":
                assert replica.receive(datagram)
    assert len(replica.components()) == 0
    assert [len(replica.components(frame)) for frame in frames] == [1, 1, 1]


def test_records_of_frames_survive_their_datagram():
    record = FrameMessage(first_key(2, 9), 2 << 24 | 9, 3, WORLD, pose_of(motion(2.0, 0.3)))
    found = decode(encode_record(record))
    assert isinstance(found, FrameMessage)
    assert (found.key, found.frame, found.version, found.anchor) == (record.key, record.frame, 3, WORLD)
    assert torch.equal(found.pose, record.pose)
    free = replace(record, anchor=record.frame, pose=None)
    assert decode(encode_record(free)).pose is None
    for bad in (
        replace(record, frame=3 << 24),  # of another robot
        replace(record, anchor=-2),
        replace(record, anchor=record.frame),
        replace(record, pose=None),
        replace(record, pose=2 * record.pose),
        replace(record, anchor=1 << 34),
    ):
        with pytest.raises(InvalidArgumentError, match="Record"):
            encode_record(bad)
    with pytest.raises(DataError, match="truncated"):
        decode(sealed(b"\x1f" + bytes(5)))
