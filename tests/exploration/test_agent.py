"""Agent and Radio: how they treat messages of any kind, and when they send."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from exploration.mapped_room import BOX, CAMERA, NOVELTY, PLACES, frame, mapper
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components
from sharing.message_examples import examples, frame_of_components, views

from gmmtorch.errors import DataError
from gmmtorch.occupancy.voxels.cells import CellEvidence
from gmmtorch.team.exploration import Agent, Stopwatch, TeamOptions
from gmmtorch.team.exploration.planning.collision_checking import PeerTrajectories, cells_in_sphere
from gmmtorch.team.exploration.planning.planner_interface import Plan, PlanningTask
from gmmtorch.team.exploration.planning.primitives import Primitives
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator
from gmmtorch.team.exploration.robot.agent import Robot, StoppingRule
from gmmtorch.team.exploration.robot.mapper import GridMapper, Mapper, Memo
from gmmtorch.team.exploration.world.starts import InitialFreeSpace
from gmmtorch.team.sharing.messages.component_messages import encode_components
from gmmtorch.team.sharing.messages.message_registry import decode, kind_of
from gmmtorch.team.sharing.messages.mission_messages import (
    PlanMessage,
    encode_plan,
    quantized_poses,
    quantized_views,
)
from gmmtorch.team.sharing.messages.record_messages import encode_announcements
from gmmtorch.team.sharing.replica.record_keys import Intervals
from gmmtorch.team.sharing.replica.replica import Replica

START = torch.tensor([*PLACES[0][0], PLACES[0][1]], dtype=torch.float64)
LAUNCH = InitialFreeSpace(cells_in_sphere(START[:3], 1.4, 0.2), START[None, :3])
PRIMITIVES = Primitives(TeamOptions().dynamics)
EVALUATOR = ViewEvaluator(
    CAMERA.horizontal_fov, CAMERA.vertical_fov, CAMERA.max_range, resolution=0.2, n_beams=20
)
MAPS = ("replica", "float", "grid_shared", "grid_isolated")


class Post:
    """A network that records what is sent, and delivers what the test puts into `coming`."""

    def __init__(self) -> None:
        self.sent: list[tuple[float, int, bytes, str]] = []
        self.coming: list[tuple[int, bytes]] = []

    def send(self, sender: int, datagrams: Sequence[bytes], now: float, kind: str) -> None:
        self.sent += [(now, sender, datagram, kind) for datagram in datagrams]

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        come, self.coming = self.coming, []
        return come

    def of(self, kind: str) -> list[tuple[float, bytes]]:
        return [(now, datagram) for now, _, datagram, what in self.sent if what == kind]


class Ahead:
    """A planner whose only plan is to fly ahead."""

    def plan(self, task: PlanningTask) -> Plan:
        path = PRIMITIVES.rollout(task.state[None])[0, int(PRIMITIVES.commands[:, 0].argmax())]
        return Plan(path, PRIMITIVES.braking(path[-1]), path[-1:, :4], 1.0, "explore")


def agent(number: int = 0, kind: str = "replica", **options: Any) -> tuple[Agent, Post]:
    framework = kind if kind.startswith("grid") else "gmm_shared"
    team = TeamOptions(framework=framework, size=3, camera=CAMERA, window=(40, 40, 20), **options)
    made: Mapper = mapper(number, "replica" if kind.startswith("grid") else kind)
    if kind.startswith("grid"):
        made = GridMapper(number, made.local, made.belief, replace(team, novelty=NOVELTY), Memo(64))
    robot = Robot(number, START, made, Ahead(), LAUNCH, StoppingRule())
    post = Post()
    return Agent(robot, post, EVALUATOR, PRIMITIVES, team, Memo(256), Stopwatch()), post


def hear(one: Agent, post: Post, *pairs: tuple[int, bytes], now: float = 0.0) -> None:
    post.coming += pairs
    one.listen(now)


def learned(number: int, kind: str = "replica", places: Sequence[Any] = PLACES) -> list[bytes]:
    """All datagrams of an agent that looks around."""
    one, post = agent(number, kind)
    for seed, place in enumerate(places):
        one.learn(frame(*place, seed=seed), float(3 * seed))
    return [datagram for _, _, datagram, _ in post.sent]


@pytest.fixture(scope="module")
def recorded() -> list[list[bytes]]:
    return [learned(number, places=(PLACES[number:] * 2)[:5]) for number in (1, 2)]


# -- messages ----------------------------------------------------------------------------------------


def unusual_datagrams() -> list[bytes]:
    """Sound datagrams of all kinds that no teammate would send."""
    teammate = Replica(5, dim=3, incarnation=3)
    ids = teammate.add(frame_of_components(6))
    teammate.count({(5, int(ids[0, 1])): 4.0})
    teammate.correct(1, torch.eye(4, dtype=torch.float64), ids[:2])
    teammate.add(frame_of_components(2), supersedes=ids[3:])
    made = [*examples(), *teammate.datagrams(), *teammate.announcements()]
    far = frame_of_components(5, center=5e5, robot=3)
    wide = random_components(
        3, k=4, center=2.0, deviations=(1e-3, 300.0), robot=4, n_origins=1, max_sightings=1
    )
    flat = random_components(2, k=4, robot=6)
    for strange in (far, wide, flat):
        made += [*encode_components(strange), *encode_components(strange, "float")]
    poses = views(3, center=1e6).poses
    return [*made, *encode_plan(0, 3, 1e6, 0.2, poses, poses), *encode_plan(900, 3, 0.0, 0.2, poses, poses)]


SOUND = unusual_datagrams()
damaged = st.one_of(
    st.binary(max_size=80),
    st.tuples(st.sampled_from(SOUND), st.integers(0, 1199), st.integers(1, 255)).map(
        lambda t: t[0][: (at := t[1] % len(t[0]))] + bytes([t[0][at] ^ t[2]]) + t[0][at + 1 :]
    ),
    st.tuples(st.sampled_from(SOUND), st.integers(0, 1199)).map(lambda t: t[0][: t[1] % len(t[0])]),
    st.sampled_from(SOUND).map(lambda datagram: datagram + b"\0"),
)
AGENTS = {kind: agent(kind=kind) for kind in ("replica", "float", "grid_shared")}


@pytest.mark.parametrize("kind", list(AGENTS))
@settings(max_examples=60, deadline=None)
@given(noise=st.lists(damaged, min_size=1, max_size=4), sender=st.integers(0, 40))
def test_damaged_datagrams_are_counted_and_dropped(kind: str, noise: list[bytes], sender: int) -> None:
    one, post = AGENTS[kind]
    before = (one.radio.n_received, one.radio.n_damaged, one.digest(), one.robot.mapper.belief.entropy_bits)
    n_damaged = sum(map(is_damaged, noise))
    assert n_damaged == len(noise)
    hear(one, post, *((sender, datagram) for datagram in noise))
    assert one.radio.n_received == before[0] + len(noise)
    assert one.radio.n_damaged == before[1] + n_damaged
    assert (one.digest(), one.robot.mapper.belief.entropy_bits) == before[2:]


def is_damaged(datagram: bytes) -> bool:
    try:
        decode(datagram)
    except DataError:
        return True
    return False


@pytest.mark.parametrize("kind", MAPS)
def test_all_sound_datagrams_are_accepted(kind: str) -> None:
    one, post = agent(kind=kind)
    one.learn(frame(*PLACES[0]), 0.0)
    for number, datagram in enumerate([*SOUND, *SOUND[::-1]]):
        hear(one, post, (number % 4, datagram), now=1.0 + number)
    assert one.radio.n_damaged == 0
    assert one.radio.n_received == 2 * len(SOUND)
    belief = one.robot.mapper.belief
    for part in belief.grid.dense(BOX):
        assert bool(part.isfinite().all())
        assert bool((part >= 0).all())
    one.learn(frame(*PLACES[1]), 1e3)
    one.begin_planning(1e3)
    one.propose(1e3, [0, 1, 2, 900], PeerTrajectories.of([]))
    one.send_plan(1e3, 1)


def test_evidence_is_equal_to_the_bit_whichever_sender_was_faster(recorded: list[list[bytes]]) -> None:
    one, other = recorded
    found = []
    for first, second in ((1, 2), (2, 1)):
        listener, post = agent()
        for said in zip(one, other, strict=False):
            hear(listener, post, *((number, said[number - 1]) for number in (first, second)))
        found.append(listener.robot.mapper.belief.grid.dense(BOX))
    for a, b in zip(*found, strict=True):
        assert torch.equal(a, b)


# -- plans ----------------------------------------------------------------------------------------------


def plan_datagram(number: int, x: float, sender: int = 1, steps: int = 10) -> bytes:
    """A plan to stay at x for `steps` steps of 0.2 s."""
    poses = torch.tensor([[x, 0.0, 0.0, 0.0]], dtype=torch.float64).expand(steps, 4)
    (datagram,) = encode_plan(sender, number, float(number), 0.2, poses, poses[:1])
    return datagram


def test_an_overtaken_plan_is_ignored() -> None:
    one, post = agent()
    said = {number: plan_datagram(number, float(number)) for number in range(1, 9)}
    latest = 0
    for when, number in enumerate([2, 4, 3, 4, 1, 8, 5]):
        hear(one, post, (1, said[number]), now=10.0 + when / 4)
        if number > latest:
            latest, heard = number, 10.0 + when / 4
        assert one.robot.plans[1].number == latest
        assert one.heard_at[1] == heard
    assert list(one.robot.plans) == [1]


def test_a_much_lower_plan_number_is_accepted() -> None:
    one, post = agent()
    hear(one, post, (1, plan_datagram(400, 1.0)), (2, plan_datagram(7, 3.0, sender=2)))
    hear(one, post, (1, plan_datagram(0, 2.0)))
    assert one.robot.plans[1].path.tolist() == [[2.0, 0.0, 0.0, 0.0]] * 10
    assert one.robot.plans[2].number == 7


def test_plans_of_strangers_and_under_another_id_are_ignored() -> None:
    one, post = agent(number=1)
    hear(one, post, *((sender, plan_datagram(0, 1.0, 2)) for sender in (0, 1, 3, 900)))  # of another
    hear(one, post, (1, plan_datagram(0, 1.0, 1)))  # its own
    for stranger in (3, 4, 900, (1 << 60) - 1):  # in a team of three
        hear(one, post, (stranger, plan_datagram(0, 1.0, stranger, 1000)))
    assert one.robot.plans == one.heard_at == {}
    assert one.refused == {"stranger": 9}
    hear(one, post, (0, plan_datagram(0, 1.0, 0)), (2, plan_datagram(0, 1.0, 2)))
    assert sorted(one.robot.plans) == sorted(one.heard_at) == [0, 2]
    assert one.refused == {"stranger": 9}


def fly(one: Agent, now: float, number: int, rests: bool) -> None:
    one.robot.should_rest = lambda now: rests  # type: ignore[method-assign]
    one.begin_planning(now)
    one.propose(now, [], PeerTrajectories.of([]))
    one.follow()
    one.send_plan(now, number)
    one.robot.advance(0, 100)


def test_a_plan_is_sent_unless_no_teammate_can_be_near() -> None:
    one, post = agent()
    hear(one, post, (1, plan_datagram(0, 500.0, sender=1)), now=0.0)
    fly(one, 0.0, 0, rests=False)  # robot 2 may be anywhere
    hear(one, post, (2, plan_datagram(0, -500.0, sender=2)), now=2.0)
    for number in range(1, 5):
        fly(one, 2.0 * number, number, rests=False)
    hear(one, post, (2, encode_plan(2, 9, 0.0, 0.2, torch.zeros(0, 4))[0]), now=10.0)  # it may be anywhere
    fly(one, 10.0, 5, rests=False)
    hear(one, post, (2, plan_datagram(10, -30.0, sender=2)), now=12.0)
    fly(one, 12.0, 6, rests=False)
    fly(one, 60.0, 7, rests=False)  # it may have flown 80 m since
    fly(one, 61.0, 70, rests=False)  # but knows since a second ago where this robot is, and is silent
    for number, behind in ((11, 7.0), (12, 4.0)):  # out of the range of a camera, and within it
        x = float(one.robot.position[0]) - behind
        hear(one, post, (2, plan_datagram(number, x, sender=2)), now=40.0 + 2 * number)
        fly(one, 40.0 + 2 * number, number - 3, rests=False)
    assert [decode(datagram).number for _, datagram in post.of("plans")] == [0, 5, 7, 9]


def test_components_show_where_a_teammate_is_unless_they_are_old_or_of_another_robot() -> None:
    one, post = agent()
    other, far = Replica(2, incarnation=0), Replica(1, incarnation=0)
    for replica, x in ((far, 500.0), (other, 0.0), (other, -500.0)):
        made = random_components(3, k=4, seed=3)
        replica.add(replace(made, origins=made.origins * 0 + torch.tensor([x, 0.0, 0.0])))
        for datagram in replica.datagrams():
            hear(one, post, (replica.robot, datagram), now=0.0)
            hear(one, post, (1, datagram), now=0.0)  # relayed
    fly(one, 0.0, 0, rests=False)
    hear(one, post, *((2, datagram) for datagram in other.datagrams()), now=2.0)
    old = encode_components(other.components().selected(torch.arange(4)))
    hear(one, post, *((2, datagram) for datagram in old), now=2.0)
    fly(one, 2.0, 1, rests=False)
    assert post.of("plans") == []
    fly(one, 400.0, 2, rests=False)  # they may be anywhere by now
    assert len(post.of("plans")) == 1


def test_a_plan_has_every_second_pose_and_the_views_after_the_path() -> None:
    one, post = agent()
    local = one.robot.mapper.local
    local.add(CellEvidence.from_dense(local.box.low, torch.zeros(local.shape), torch.full(local.shape, 50.0)))
    fly(one, 0.0, 0, rests=False)
    (datagram,) = (datagram for _, datagram in post.of("plans"))
    plan, said = one._plan, decode(datagram)
    assert isinstance(said, PlanMessage)
    assert plan is not None
    assert said.step == pytest.approx(2 * one.options.dynamics.step)
    assert torch.equal(said.path, quantized_poses(plan.path[1::2, :4]))
    assert torch.equal(said.views, quantized_views(plan.views[1:]))
    assert torch.equal(said.path[-1], quantized_poses(plan.views[:1])[0])


def test_a_resting_robot_sends_one_plan_in_ten() -> None:
    one, post = agent()
    for number in range(25):
        fly(one, 2.0 * number, number, rests=True)
    plans = [decode(datagram) for _, datagram in post.of("plans")]
    assert [plan.number for plan in plans if isinstance(plan, PlanMessage)] == [0, 10, 20]


def test_a_moving_robot_sends_every_plan_and_the_first_at_rest() -> None:
    one, post = agent()
    local = one.robot.mapper.local  # where all is free, nothing keeps it from flying
    local.add(CellEvidence.from_dense(local.box.low, torch.zeros(local.shape), torch.full(local.shape, 50.0)))
    rests = [False] * 2 + [True] * 16 + [False] + [True] * 4
    for number, at_rest in enumerate(rests):
        fly(one, 2.0 * number, number, at_rest)
    told = [decode(datagram).number for _, datagram in post.of("plans")]
    # The plan that comes to rest still moves; the next one is the first at rest.
    assert told == [0, 1, 2, 3, 13, 18, 19, 20]


# -- what it sends ----------------------------------------------------------------------------------------


def test_few_components_wait_for_more_while_the_robot_flies_and_nobody_lacks_one() -> None:
    one, post = agent(announce_every=10.0)
    shared = one.robot.mapper.shared
    assert isinstance(shared, Replica)
    for second in range(33):
        is_many = second == 15
        if second < 29:  # then it has landed
            shared.add(random_components(3, k=50 if is_many else 2, seed=second))
            one._sensed_at = float(second)
        if second == 24:  # a teammate has lost the first component
            rest = shared.held - Intervals.span(int(shared.held.edges[0]), int(shared.held.edges[0]) + 1)
            hear(one, post, (1, encode_announcements(1, 0, rest)[0]), now=24.0)
        one.send_map(float(second))
    sent = {now: len(decode(datagram).components) for now, datagram in post.of("components")}
    assert sum(sent.values()) == shared.n_components + 1
    assert list(sent) == [0.0, 10.0, 16.0, 24.0, 30.0]
    assert not shared.missing


def test_views_are_sent_every_forty_seconds_and_after_the_clock_was_set_back() -> None:
    one, post = agent()
    for second in (0.0, 2.0, 39.0, 40.0, 42.0, 3.0):
        place = torch.tensor([[100.0 * second, 0.0, 0.0, 0.0]], dtype=torch.float64)
        one.robot.library.add(place, torch.ones(1), second, 0.0)
        one.send_views(second)
    assert [now for now, _ in post.of("views")] == [0.0, 40.0, 3.0]
    assert sum(len(decode(datagram).ids) for _, datagram in post.of("views")) == 6


@pytest.mark.parametrize("kind", MAPS)
def test_datagrams_are_sent_under_their_kind(kind: str) -> None:
    one, post = agent(2, kind, announce_every=1.0)
    for seed in range(20):
        for place in PLACES[:2]:
            one.learn(frame(*place, seed=seed), float(seed))
    one.robot.library.add(views(2).poses, torch.ones(2), 1.0, 0.0)
    one.send_views(5.0)
    fly(one, 5.0, 1, rests=False)
    kinds = Counter(kind for _, _, _, kind in post.sent)
    assert all(kind_of(datagram) == kind for _, _, datagram, kind in post.sent)
    assert all(sender == 2 for _, sender, _, _ in post.sent)
    expected = {
        "replica": {"components", "counts", "views", "plans", "announcements"},
        "float": {"components", "counts", "views", "plans"},
        "grid_shared": {"points", "views", "plans"},
        "grid_isolated": set(),
    }[kind]
    assert set(kinds) - {"supersessions"} == expected


def assert_within(rate: float, said: list[tuple[float, bytes]]) -> None:
    """In every interval, no more than `rate` bytes per second and one second's bytes before."""
    for begin, end in itertools.combinations_with_replacement(range(41), 2):
        size = sum(len(datagram) for now, datagram in said if begin <= now <= end)
        assert size <= rate * (end - begin + 1) + 1


def test_a_budget_bounds_the_map_bytes_in_every_interval() -> None:
    one, post = agent(kind="grid_shared", budget=1500.0, announce_every=1.0)
    for seed, place in enumerate(PLACES):
        one.robot.sense(frame(*place, seed=seed))
    for tick in range(40):
        one.send_map(float(tick))
    said = post.of("points")
    assert sum(len(datagram) for _, datagram in said) > 10_000
    assert one.robot.mapper.shared.datagrams() == []  # everything was sent in the end
    assert_within(1500.0, said)


def test_views_use_what_the_map_leaves_of_the_budget() -> None:
    one, post = agent(kind="grid_shared", budget=1300.0, announce_every=1e6)
    places = torch.rand(200, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64) * 300.0
    one.robot.library.add(places, torch.ones(200), 0.0, 0.0, most=200)
    for seed, place in enumerate(PLACES):
        one.robot.sense(frame(*place, seed=seed))
    for tick in range(800):  # ten times a second
        one.send_map(tick / 10)
        one.send_views(tick / 10)
    assert_within(1300.0, [(now, datagram) for now, _, datagram, _ in post.sent])
    last_of_map = max(now for now, _ in post.of("points"))
    assert last_of_map > 5.0
    # While records wait, views are sent only if a whole datagram fits.
    assert sum(len(datagram) for now, datagram in post.of("views") if now < last_of_map) <= 1300
    told = [decode(datagram) for _, datagram in post.of("views")]
    assert sum(len(m.ids) for m in told) == len(one.robot.library) > 50  # all in the end


def test_announcements_ignore_the_budget_and_become_rare() -> None:
    one, post = agent(budget=1e-3, announce_every=2.0)
    assert one.radio.within_budget(lambda budget: [bytes(1100)], 0.0)  # of the 1200 bytes at the start
    for seed, place in enumerate(PLACES):
        one.robot.sense(frame(*place, seed=seed))
    for tick in range(40):
        one.send_map(float(tick))
    assert sum(len(datagram) for _, datagram in post.of("components")) <= 200
    assert one.robot.mapper.shared.datagrams()  # the rest is still due
    assert sorted({now for now, _ in post.of("announcements")}) == [2.0, 10.0, 26.0]
