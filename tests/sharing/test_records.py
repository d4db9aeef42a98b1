"""Sets of keys, sums of counters, and records other than components: encoding, and resending."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components, rotations
from sharing.message_examples import examples, sealed
from sharing.schedules import act

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.codec.bitstream import BitWriter
from gmmtorch.mapping.codec.quantization import COUNT_ERROR
from gmmtorch.occupancy.calibrator import Calibrator
from gmmtorch.team.sharing import MAX_BYTES, Replica, decode
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, counts_of, encode_components
from gmmtorch.team.sharing.messages.datagrams import pose_of, write_intervals, write_keys
from gmmtorch.team.sharing.messages.record_messages import (
    RECORD_KINDS,
    AnnouncementMessage,
    CorrectionMessage,
    CountersMessage,
    SupersessionMessage,
    counters_message,
    encode_announcements,
    encode_record,
    keys_in,
)
from gmmtorch.team.sharing.radio import AnnouncementSchedule
from gmmtorch.team.sharing.replica.anti_entropy import MOST_PEERS, Backlog
from gmmtorch.team.sharing.replica.materialized_view import Counters
from gmmtorch.team.sharing.replica.record_keys import END, Intervals, evict, first_key, keys_of

numbers = st.sets(st.integers(0, 40))


def set_of(values: set[int]) -> Intervals:
    return Intervals.of(np.array(list(values), np.int64))


def members(intervals: Intervals) -> set[int]:
    return {number for begin, end in intervals.pairs() for number in range(begin, end)}


@given(one=numbers, other=numbers, asked=st.lists(st.integers(-3, 45)))
def test_operations_equal_those_of_sets(one, other, asked):
    a, b = set_of(one), set_of(other)
    assert members(a) == one
    assert members(a | b) == one | other
    assert (np.diff((a | b).edges) > 0).all()
    assert len(a | b) == sum(number - 1 not in one | other for number in one | other)  # as few as possible
    assert a.contains(np.array(asked, np.int64)).tolist() == [number in one for number in asked]
    assert all((number in a) == (number in one) for number in asked)
    assert members(a & b) == one & other
    assert members(a - b) == one - other
    assert a.covers(b) == (other <= one)
    assert (a == b) == (one == other)
    assert bool(a) == bool(one)
    assert a.size == len(one)
    assert a.numbers().tolist() == sorted(one)


@given(sets=st.lists(numbers, max_size=5))
def test_union_of_many_equals_repeated_unions(sets):
    found = Intervals.union(map(set_of, sets))
    assert members(found) == set().union(*sets)
    assert found == set_of(members(found))


@given(sets=st.dictionaries(st.integers(0, 9), numbers), most=st.integers(0, 30))
def test_evict_removes_the_largest_sets_first(sets, most):
    intervals = {name: set_of(values) for name, values in sets.items()}
    gone = evict(intervals, most)
    sizes = {name: len(one) for name, one in intervals.items()}
    left = [sizes[name] for name in sizes.keys() - set(gone)]
    assert sum(left) <= most
    assert all(sizes[name] >= max(left, default=0) for name in gone)
    assert not gone or sum(left) + sizes[gone[-1]] > most


@given(one=numbers, most=st.integers(0, 20))
def test_up_to_empties_larger_sets(one, most):
    assert members(set_of(one).up_to(most)) == (one if len(set_of(one)) <= most else set())


def test_long_intervals_take_no_memory():
    whole = Intervals.span(0, 1 << 62)
    hole = Intervals.span(1 << 40, 1 << 50)
    assert (whole - hole).size == (1 << 62) - (1 << 50) + (1 << 40)
    assert len(whole - hole) == 2
    assert not Intervals.span(5, 5)
    assert not Intervals.span(6, 5)
    assert repr(Intervals.span(3, 6)) == "Intervals(3…5)"


@pytest.mark.parametrize("edges", [[1], [2, 1], [1, 1], [0, 2, 2, 3]])
def test_invalid_edges_are_refused(edges):
    with pytest.raises(InvalidArgumentError, match="edges"):
        Intervals(np.array(edges, np.int64))


# -- counters -------------------------------------------------------------------------------------------

entries = st.dictionaries(st.integers(0, 12), st.integers(-41, 160), max_size=8)
acts = st.lists(st.tuples(st.integers(0, 2), entries, st.booleans()), max_size=25)


@given(acts=acts, choice=st.randoms(use_true_random=False))
def test_sums_equal_those_of_the_records(acts, choice):
    totals, here = Counters(), {}
    for number, (robot, row, drops) in enumerate(acts):
        names = np.array(list(row), np.int64)
        record = CountersMessage(
            first_key(robot, 3) + number, names, np.array([row[name] for name in names.tolist()], np.int64)
        )
        totals.add(record)
        here[record.key] = record
        if drops:
            gone = choice.sample(sorted(here), choice.randint(1, len(here)))
            totals.drop([here.pop(key) for key in gone])
        largest: dict[tuple[int, int], int] = {}
        for key, one in here.items():
            for name, step in zip(one.components.tolist(), one.steps.tolist(), strict=True):
                largest[name, key >> 28] = max(largest.get((name, key >> 28), step), step)
        expected = [0.0] * 14  # not by sum(), which compensates rounding since Python 3.12
        for (name, _), step in sorted(largest.items()):
            expected[name] += float(counts_of(np.array([step]))[0])
        assert totals.sums(np.arange(14)).tolist() == expected
        assert totals.keys().tolist() == sorted({name for name, _ in largest})
        assert {key for robot in range(3) for key in totals.of(first_key(robot, 3) >> 28)} == here.keys()


# -- keys in datagrams ----------------------------------------------------------------------------------


def decoded_keys(datagram: bytes) -> Intervals:
    message = decode(datagram)
    if isinstance(message, ComponentsMessage):
        return Intervals.of(keys_of(message.components.ids))
    return Intervals.span(message.key, message.key + 1)


def test_keys_in_datagrams_equal_the_decoded_keys():
    rng, replica = random.Random(3), Replica(5)
    datagrams: list[bytes] = []
    for _ in range(25):
        act(rng, replica)
        datagrams += replica.datagrams()
    replica.calibrate(Calibrator.of(12.0, 3).calibration._replace(n_predicted=90))
    datagrams += replica.datagrams()
    for dim in (2, 3):
        for k in (1, 2, 150):
            made = random_components(dim, k=k, robot=1023)
            made.ids[:, 1] = torch.randperm(1 << 20)[:k] << 32
            datagrams += encode_components(made)
    datagrams += Replica(6, own_frame=True).datagrams()
    assert {datagram[0] & 15 for datagram in datagrams} == RECORD_KINDS
    for datagram in datagrams:
        assert keys_in(datagram) == decoded_keys(datagram)


def test_datagrams_without_records_are_refused():
    components = encode_components(random_components(3, k=20))[0]
    others = [datagram for datagram in examples() if datagram[0] & 15 not in RECORD_KINDS]
    assert len(others) >= 8
    for datagram in [b"", b"\x11", components[:9], b"\x1b" + components[1:], *others]:
        with pytest.raises(DataError):
            keys_in(datagram)


robots = st.integers(0, 1023)
lives = st.integers(0, (1 << 24) - 1)
keys = st.integers(0, 300) | st.integers(0, END - 1)


def of(*numbers: int) -> Intervals:
    return Intervals.of(np.array(numbers, np.int64))


def within(robot: int, *numbers: int) -> Intervals:
    return of(*(first_key(robot) + number for number in numbers))


# -- messages --------------------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(
    sender=robots,
    incarnation=lives,
    held=st.sets(keys, max_size=400),
    max_bytes=st.sampled_from([1000, 1200]),
)
def test_decoded_announcements_equal_the_held_intervals(sender, incarnation, held, max_bytes):
    datagrams = encode_announcements(sender, incarnation, of(*held), max_bytes)
    assert all(len(datagram) <= max_bytes for datagram in datagrams)
    messages = [decode(datagram) for datagram in datagrams]
    assert {(type(m), m.sender, m.incarnation) for m in messages} == {
        (AnnouncementMessage, sender, incarnation)
    }
    told, scope = Intervals.empty(), Intervals.empty()
    for message in messages:
        assert message.scope.covers(message.held)
        assert not scope & message.scope
        told, scope = told | message.held, scope | message.scope
    assert told == of(*held)
    assert scope == Intervals.span(0, END)


def test_an_announcement_of_a_team_takes_few_bytes():
    held = Intervals.empty()
    for robot in range(16):
        begin = first_key(robot, 12345 * robot)
        held |= Intervals.span(begin, begin + 5000)
    (datagram,) = encode_announcements(3, 99, held)
    assert len(datagram) <= 16 * 11 + 30


@settings(max_examples=60, deadline=None)
@given(key=keys, totals=st.dictionaries(keys, st.floats(0, 2.0**40), max_size=30))
def test_counters_are_decoded_within_their_step(key, totals):
    message = decode(encode_record(counters_message(key, totals)))
    assert isinstance(message, CountersMessage)
    assert message.key == key
    assert message.components.tolist() == sorted(totals)
    for name, total in zip(message.components.tolist(), counts_of(message.steps).tolist(), strict=True):
        assert total == pytest.approx(totals[name], rel=COUNT_ERROR + 1e-9, abs=2.0**-10)
    assert encode_record(message) == encode_record(counters_message(key, totals))


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 999),
    dim=st.sampled_from([2, 3]),
    scan=st.integers(0, 1 << 50),
    version=st.integers(0, 99),
)
def test_corrections_are_decoded_within_their_step(seed, dim, scan, version):
    generator = torch.Generator().manual_seed(seed)
    transform = torch.eye(dim + 1, dtype=torch.float64)
    turn = rotations(1, dim, generator)[0]
    transform[:-1, :-1] = turn * torch.linalg.det(turn).sign() if dim == 3 else _proper(turn)
    transform[:-1, -1] = torch.randn(dim, generator=generator, dtype=torch.float64) * 1e4
    moved = within(5, 1, 2, 3, 9)
    sent = CorrectionMessage(first_key(5, 77), scan, version, moved, pose_of(transform))
    message = decode(encode_record(sent))
    assert isinstance(message, CorrectionMessage)
    assert (message.key, message.scan, message.version, message.moved) == (sent.key, scan, version, moved)
    assert torch.equal(message.pose, sent.pose)
    assert torch.allclose(message.transform(), transform, atol=1e-9)


def _proper(turn: torch.Tensor) -> torch.Tensor:
    return turn if torch.linalg.det(turn) > 0 else turn * torch.tensor([1.0, -1.0], dtype=torch.float64)


def test_corrections_by_half_turns_are_decoded():
    for axis in range(3):
        transform = -torch.eye(4, dtype=torch.float64)
        transform[axis, axis] = transform[3, 3] = 1.0
        message = CorrectionMessage(0, 0, 1, of(1), pose_of(transform))
        assert torch.allclose(message.transform(), transform, atol=1e-12)
    with pytest.raises(InvalidArgumentError, match="is not rigid"):
        pose_of(2 * torch.eye(3))
    with pytest.raises(InvalidArgumentError, match="shape"):
        pose_of(torch.eye(5))


# -- hostile ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "numbers",
    [
        (1024, 0, 0, 5, 0),  # no such robot
        (1, 1 << 24, 0, 5, 0),  # no such life
        (1, 2, 5, END - 1, 0),  # beyond all keys
        (1, 2, 0, 9, 1, 0, 10),  # an interval beyond its scope
        (1, 2, 0, 9, 2, 0, 0, 0, 0),  # intervals that touch
        (1, 2, 0, 9, 1, 0, -2),  # an empty one
        (1, 2, 0, 9, -1),
    ],
)
def test_invalid_announcements_are_refused(numbers):
    writer = BitWriter()
    for value in numbers:
        writer.number(value)
    with pytest.raises(DataError):
        decode(sealed(b"\x1a" + writer.to_bytes()))


def written(record: SupersessionMessage | CountersMessage | CorrectionMessage) -> bytes:
    """The datagram of a record without the checks of the encoder."""
    writer, base = BitWriter(), first_key(record.key >> 52)
    writer.number(record.key)
    if isinstance(record, SupersessionMessage):
        write_intervals(writer, record.old, base)
        write_intervals(writer, record.new, base)
        return sealed(b"\x1b" + writer.to_bytes())
    if isinstance(record, CountersMessage):
        write_keys(writer, record.components)
        writer.column(record.steps)
        return sealed(b"\x1c" + writer.to_bytes())
    writer.number(record.scan)
    writer.number(record.version)
    writer.one(record.dim - 2, 1)
    writer.fixed(record.pose.numpy().view("<u4").astype(np.int64), 32)
    write_intervals(writer, record.moved, base)
    return sealed(b"\x1d" + writer.to_bytes())


def test_invalid_records_are_neither_decoded_nor_encoded():
    key = first_key(2)
    pose = pose_of(torch.eye(4))
    long, infinite, far = pose.clone(), pose.clone(), pose.clone()
    long[6], infinite[0], far[1] = 1.1, math.inf, 1e9
    for record in (
        SupersessionMessage(key + 9, Intervals.empty(), within(2, 1)),
        SupersessionMessage(key + 9, within(2, 1), within(2, 1, 2)),  # new contains an old key
        SupersessionMessage(key + 9, within(2, 9), within(2, 1)),  # supersedes itself
        *(CorrectionMessage(key, 0, 1, within(2, 1), bad) for bad in (long, infinite, far)),
        *(SupersessionMessage(key + 9, within(robot, 5), Intervals.empty()) for robot in (1, 3)),
        *(CorrectionMessage(key, 0, 1, within(robot, 5), pose) for robot in (1, 3)),  # another's
        CorrectionMessage(key, 1 << 60, 1, within(2, 1), pose),
        CorrectionMessage(key, 0, -1, within(2, 1), pose),
        SupersessionMessage(-1, within(0, 1), Intervals.empty()),
        *(CountersMessage(key, np.array([3]), np.array([step])) for step in (-42, 161)),
        CountersMessage(key, np.array([END]), np.array([0])),
    ):
        with pytest.raises(DataError):
            decode(written(record))
        with pytest.raises(InvalidArgumentError):
            encode_record(record)
    for record in (
        SupersessionMessage(END, within(0, 1), Intervals.empty()),
        CorrectionMessage(key, 0, 1, within(2, 1), pose[:5]),
        CountersMessage(key, np.array([3, 3]), np.array([0, 0])),
        CountersMessage(key, np.array([3, 4]), np.array([0])),
    ):
        with pytest.raises(InvalidArgumentError):
            encode_record(record)


@pytest.mark.parametrize(
    ("sender", "incarnation", "held"),
    [
        (1024, 0, Intervals.span(0, 1)),
        (-1, 0, Intervals.span(0, 1)),
        (1, 1 << 24, Intervals.span(0, 1)),
        (1, 2, Intervals.span(-1, 1)),
        (1, 2, Intervals.span(5, END + 1)),
    ],
)
def test_invalid_announcements_are_not_encoded(sender, incarnation, held):
    with pytest.raises(InvalidArgumentError):
        encode_announcements(sender, incarnation, held)


# -- resending -------------------------------------------------------------------------------------------

NOTHING = Intervals.empty()


def says(sender: int, held: Intervals, scope: Intervals | None = None) -> AnnouncementMessage:
    begin, end = (scope or Intervals.span(0, END)).pairs()[0]
    return AnnouncementMessage(sender, 0, begin, end, held)


def test_the_author_resends_a_missing_record_first_and_others_later():
    backlog = Backlog(1)
    held = within(1, 0, 1, 2) | within(2, 0, 1)
    backlog.announced(says(3, within(1, 0)), held, NOTHING)
    assert backlog.due == within(1, 1, 2)
    backlog.sent(backlog.due)
    backlog.sent(Intervals.empty())
    backlog.announced(says(3, within(1, 0, 1, 2) | within(2, 0)), held, NOTHING)
    assert backlog.due == within(2, 1)
    backlog.received(within(2, 1))  # another has sent it
    assert not backlog.due


def test_records_just_sent_or_received_are_not_resent():
    backlog = Backlog(1)
    held = within(1, 0, 1)
    backlog.sent(within(1, 0))
    backlog.announced(says(3, NOTHING), held, NOTHING)
    assert backlog.due == within(1, 1)
    for n_calls in range(1, 4):
        backlog.sent(within(1, 1))
        backlog.announced(says(3, NOTHING), held, NOTHING)
        # The announcement may be older than the datagram; in the end the record counts as missing.
        assert backlog.due == (within(1, 0) if n_calls == 3 else Intervals.empty())


def test_an_announcement_covers_only_its_scope():
    backlog = Backlog(1)
    held = within(1, 0, 1, 2, 3, 4)
    part = Intervals.span(first_key(1) + 1, first_key(1) + 4)
    backlog.announced(says(3, within(1, 2), part), held, NOTHING)
    assert backlog.due == within(1, 1, 3)


def test_gaps_are_remembered_for_a_bounded_number_of_robots():
    backlog = Backlog(1)
    for sender in range(2, 2 + 3 * MOST_PEERS):
        backlog.announced(says(sender, NOTHING), within(0, 1), NOTHING)
    assert len(backlog._gaps) == MOST_PEERS


def test_a_late_robot_receives_all_records_from_a_third_robot():
    one, relay, late = Replica(0), Replica(1), Replica(2)
    one.add(random_components(3, k=300))
    one.count({tuple(one.components().ids[0].tolist()): 100.0})
    for datagram in one.datagrams():
        relay.receive(datagram)
    sent = []
    for _ in range(4):  # `one` is gone
        for datagram in late.announcements():
            relay.receive(datagram)
        sent.append(relay.datagrams())
        for datagram in sent[-1]:
            assert late.receive(datagram)
    # It counts as in flight until then.
    assert [bool(datagrams) for datagrams in sent] == [False, False, False, True]
    assert late.digest() == relay.digest() == one.digest()
    for datagram in late.announcements():
        relay.receive(datagram)
    assert relay.datagrams() == []


def test_a_later_record_shows_that_an_earlier_one_was_lost():
    one, other = Replica(0, incarnation=5), Replica(1, incarnation=9)
    assert other.is_complete
    sent = []
    for seed in range(2):
        one.add(random_components(3, k=5, seed=seed))
        sent += one.datagrams()
    assert other.receive(sent[1])
    assert not other.is_complete
    assert other.receive(sent[0])
    assert other.is_complete


def test_a_robot_that_lacks_no_record_announces_every_fourth_period_while_records_change():
    for complete, urgent, expected in (
        (True, False, [10, 50, 90, 130]),
        (False, False, [*range(10, 140, 10)]),
        (True, True, [*range(10, 140, 10)]),
    ):
        schedule = AnnouncementSchedule(10.0)
        said = [now for now in range(140) if schedule.due(float(now), (now,), urgent, complete)]
        assert said == expected


def test_replicas_with_equal_records_send_only_announcements():
    replicas = [Replica(robot) for robot in range(3)]
    for replica in replicas:
        replica.add(random_components(3, k=10, seed=replica.robot))
    for _ in range(4):
        said = {replica.robot: [*replica.announcements(), *replica.datagrams()] for replica in replicas}
        for sender, datagrams in said.items():
            for replica in replicas:
                for datagram in datagrams if replica.robot != sender else []:
                    replica.receive(datagram)
    assert len({replica.digest() for replica in replicas}) == 1
    assert all(replica.datagrams() == [] for replica in replicas)
    assert all(len(datagram) < 60 <= MAX_BYTES for r in replicas for datagram in r.announcements())


def test_a_returned_own_datagram_is_no_duplicate_robot_id():
    one = Replica(0)
    one.add(random_components(3, k=3))
    for datagram in [*one.announcements(), *one.datagrams()]:
        one.receive(datagram)
    assert one.refused == {"own": 1}
    assert not one.duplicates
