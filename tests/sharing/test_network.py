"""The simulated network: who hears what, when, how often, and what it costs."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.sharing.transport.link_conditions import LinkConditions, Partition
from gmmtorch.sharing.transport.simulated_network import HEADER_BYTES, Network, Reception, Traffic

N = 3
UNLIKELY = 1e-4  # seeds are fixed: what passes once always does

sent = st.lists(
    st.tuples(
        st.integers(0, N - 1),  # sender
        st.lists(st.binary(max_size=40), max_size=4),
        st.floats(0, 3),  # seconds since the last
        st.sampled_from(["maps", "plans"]),
    ),
    max_size=25,
)
groupings = st.sampled_from([[[0]], [[1, 2]], [[0], [1], [2]], [[2], [0]]])
partitions = st.lists(
    st.tuples(st.floats(0, 30), st.floats(0.01, 20), groupings).map(lambda p: (p[0], p[0] + p[1], p[2])),
    max_size=3,
)
conditions = st.builds(
    LinkConditions,
    latency=st.sampled_from([0.0, 0.5]),
    jitter=st.sampled_from([0.0, 0.1, 4.0]),
    bandwidth=st.sampled_from([None, 50.0]),
    loss=st.sampled_from([0.0, 0.4]),
    duplication=st.sampled_from([0.0, 0.5, 1.0]),
    reach=st.sampled_from([None, 1.0, 2.5]),
    partitions=partitions,
)
walks = st.lists(st.lists(st.floats(0, 3), min_size=N, max_size=N), min_size=25, max_size=25)


def on_a_line(xs: list[float]) -> torch.Tensor:
    return torch.tensor([[x, 1.0, 2.0] for x in xs], dtype=torch.float64)


def network_of(n: int, seed: int = 0, **options: Any) -> Network:
    return Network(n, LinkConditions(**options), seed)


def numbered(n: int) -> list[bytes]:
    return [i.to_bytes(2, "little") for i in range(n)]


def heard(network: Network, robot: int, now: float = 1e9) -> list[bytes]:
    return [data for _, data in network.deliver(robot, now)]


# -- without trouble ----------------------------------------------------------------------------------


def test_all_but_the_sender_hear_a_datagram_once_after_the_latency():
    network = network_of(3, latency=0.5)
    network.send(1, [b"a", b"b"], 10.0, "maps")
    assert [network.deliver(robot, 10.49) for robot in range(3)] == [[], [], []]
    assert [network.deliver(robot, 10.5) for robot in range(3)] == [
        [(1, b"a"), (1, b"b")],
        [],
        [(1, b"a"), (1, b"b")],
    ]
    assert [network.deliver(robot, 99.0) for robot in range(3)] == [[], [], []]
    assert network.n_in_flight == 0


def test_a_slow_sender_makes_its_own_datagrams_wait_not_others():
    size = 100 - HEADER_BYTES
    network = network_of(3, latency=0.0, bandwidth=100.0)
    network.send(0, [bytes(size), bytes(size)], 0.0, "maps")  # a second on the air each
    network.send(0, [b""], 0.5, "maps")
    network.send(1, [b"quick"], 0.5, "plans")
    assert network.deliver(2, 0.5 + 33 / 100) == [(1, b"quick")]
    assert network.deliver(2, 0.99) == []
    assert network.deliver(2, 1.0) == [(0, bytes(size))]
    assert network.deliver(2, 2.0) == [(0, bytes(size))]
    assert network.deliver(2, 2.27) == []
    assert network.deliver(2, 2.29) == [(0, b"")]
    network.send(0, [bytes(size)], 50.0, "maps")  # by now the air is free
    assert network.deliver(2, 51.0) == [(0, bytes(size))]


@given(sent=sent, latency=st.floats(0, 2), bandwidth=st.none() | st.floats(1, 200))
def test_without_loss_everything_arrives_in_order_and_on_time(sent, latency, bandwidth):
    """Against a list of all arrivals that is worked out by hand and sorted."""
    network, now = network_of(N, latency=latency, bandwidth=bandwidth), 0.0
    expected, free = [], [0.0] * N
    for sender, datagrams, pause, kind in sent:
        now += pause
        network.send(sender, datagrams, now, kind)
        for data in datagrams:
            free[sender] = max(now, free[sender]) + (0 if bandwidth is None else (len(data) + 28) / bandwidth)
            expected.append((free[sender] + latency, len(expected), sender, data))
    middle, end = now / 2 + latency, 1e9
    for robot in range(N):
        of_others = [a for a in sorted(expected) if a[2] != robot]
        early = network.deliver(robot, middle)
        assert early == [(sender, data) for time, _, sender, data in of_others if time <= middle]
        assert early + network.deliver(robot, end) == [(sender, data) for _, _, sender, data in of_others]


# -- all rules at once, by brute force ------------------------------------------------------------------


class Model:
    """The rules in plain Python: a list of all copies, and a link that is asked at every instant at which it
    may have changed. Its draws are those of a network with the same seed."""

    def __init__(self, conditions: LinkConditions, seed: int) -> None:
        self.c, self.free, self.n = conditions, [0.0] * N, 0
        self.losses = torch.Generator().manual_seed(seed)
        self.delays = torch.Generator().manual_seed(seed ^ 0x5851F42D4C957F2D)
        self.coming: list[list[tuple[float, int, int, bytes]]] = [[] for _ in range(N)]
        self.books: list[Counter[str]] = [Counter() for _ in range(N)]

    def linked(self, a: int, b: int, time: float) -> bool:
        for begin, end, groups in self.c.partitions:
            rest = set(range(N)) - {robot for group in groups for robot in group}
            if begin <= time < end and not any({a, b} <= set(group) for group in [*groups, rest]):
                return False
        return True

    def linked_throughout(self, a: int, b: int, begin: float, end: float) -> bool:
        changes = [time for p in self.c.partitions for time in p[:2] if begin < time <= end]
        return all(self.linked(a, b, time) for time in [begin, *changes, end])

    def send(self, sender: int, datagrams: list[bytes], now: float, xs: list[float]) -> None:
        for data in datagrams:
            begin = left = now
            if self.c.bandwidth is not None:
                begin = max(now, self.free[sender])
                left = self.free[sender] = begin + (len(data) + 28) / self.c.bandwidth
            chances = torch.rand(N - 1, generator=self.losses, dtype=torch.float64) if self.c.loss else None
            late = None
            if self.c.jitter or self.c.duplication:
                late = torch.rand(3, N - 1, generator=self.delays, dtype=torch.float64)
            for i, robot in enumerate(r for r in range(N) if r != sender):
                times = [left + self.c.latency]
                if late is not None:
                    n_copies = 2 if late[2, i] < self.c.duplication else 1
                    times = [
                        left + (self.c.latency - self.c.jitter * math.log1p(-float(late[copy, i])))
                        for copy in range(n_copies)
                    ]
                through = [self.linked_throughout(sender, robot, begin, time) for time in times]
                if self.c.reach is not None and abs(xs[sender] - xs[robot]) > self.c.reach:
                    self.books[robot]["out_of_reach"] += 1
                elif not through[0]:
                    self.books[robot]["cut_off"] += 1
                elif chances is not None and chances[i] < self.c.loss:
                    self.books[robot]["lost"] += 1
                else:
                    self.books[robot]["duplicated"] += len(times) - 1
                    self.books[robot]["cut_off"] += through.count(False)
                    self.coming[robot] += [
                        (time, self.n, sender, data) for time, ok in zip(times, through, strict=True) if ok
                    ]
            self.n += 1

    def deliver(self, robot: int, now: float) -> list[tuple[int, bytes]]:
        due = sorted(arrival for arrival in self.coming[robot] if arrival[0] <= now)
        self.coming[robot] = [arrival for arrival in self.coming[robot] if arrival[0] > now]
        self.books[robot]["datagrams"] += len(due)
        self.books[robot]["bytes"] += sum(len(data) for *_, data in due)
        return [(sender, data) for _, _, sender, data in due]


@settings(max_examples=80)
@given(conditions=conditions, sent=sent, walks=walks, seed=st.integers(0, 9))
def test_the_rules_by_brute_force(conditions, sent, walks, seed):
    network, model, now = Network(N, conditions, seed), Model(conditions, seed), 0.0
    for (sender, datagrams, pause, kind), xs in zip(sent, walks, strict=False):
        now += pause
        network.place(on_a_line(xs))
        network.send(sender, datagrams, now, kind)
        model.send(sender, datagrams, now, xs)
        listener = (sender + 1) % N
        assert network.deliver(listener, now) == model.deliver(listener, now)
    for robot in range(N):
        assert network.deliver(robot, 1e9) == model.deliver(robot, 1e9)
        assert network.reception(robot) == Reception(**model.books[robot])


@settings(max_examples=100)
@given(conditions=conditions, sent=sent, seed=st.integers(0, 9))
def test_what_comes_was_sent_before_and_comes_at_most_twice_and_unchanged(conditions, sent, seed):
    network, now = Network(N, conditions, seed), 0.0
    network.place(on_a_line([0.0, 1.0, 2.0]))
    begun: dict[bytes, tuple[int, float]] = {}
    times: Counter[tuple[int, bytes]] = Counter()
    for i, (sender, datagrams, pause, kind) in enumerate(sent):
        now += pause
        marked = [bytes([i, j]) + data for j, data in enumerate(datagrams)]  # no two are equal
        begun |= dict.fromkeys(marked, (sender, now))
        network.send(sender, marked, now, kind)
        for time in (now, now + 0.4, 1e9 if i + 1 == len(sent) else now + 0.4):
            for robot in range(N):
                for who, data in network.deliver(robot, time):
                    assert who != robot
                    assert who == begun[data][0]
                    assert time >= begun[data][1] + conditions.latency
                    times[robot, data] += 1
        now += 0.4
    assert max(times.values(), default=0) <= (2 if conditions.duplication else 1)


@settings(max_examples=60)
@given(conditions=conditions, sent=sent, seed=st.integers(0, 9))
def test_the_books_of_receivers_balance_at_any_time(conditions, sent, seed):
    network, now, to_hear = Network(N, conditions, seed), 0.0, 0
    network.place(on_a_line([0.0, 1.0, 2.0]))
    for sender, datagrams, pause, kind in sent:
        now += pause
        network.send(sender, datagrams, now, kind)
        network.deliver(sender, now)
        to_hear += (N - 1) * len(datagrams)
        r = network.reception()
        assert to_hear + r.duplicated == (
            r.datagrams + r.lost + r.cut_off + r.out_of_reach + network.n_in_flight
        )
        each = [network.reception(robot) for robot in range(N)]
        assert r == Reception(*map(sum, zip(*each, strict=True)))


# -- loss, duplication, jitter: by their distributions --------------------------------------------------


def test_what_is_lost_is_lost_to_each_receiver_by_itself():
    n, loss = 4000, 0.3
    network = network_of(3, loss=loss, seed=5)
    network.send(0, numbered(n), 0.0, "maps")
    got = [set(heard(network, robot)) for robot in (1, 2)]
    for each in got:
        assert stats.binomtest(len(each), n, 1 - loss).pvalue > UNLIKELY
    assert stats.binomtest(len(got[0] & got[1]), n, (1 - loss) ** 2).pvalue > UNLIKELY
    assert network.traffic() == Traffic(n, 2 * n)  # sent all the same, and once
    assert [network.reception(robot).lost for robot in range(3)] == [0, n - len(got[0]), n - len(got[1])]


def test_the_seed_decides_what_is_lost_late_and_repeated():
    def run(seed: int) -> list[list[bytes]]:
        network = network_of(2, loss=0.2, jitter=1.0, duplication=0.3, seed=seed)
        network.send(0, numbered(64), 0.0, "maps")
        return [heard(network, 1, now / 4) for now in range(40)]

    assert run(1) == run(1)
    assert run(1) != run(2)


def test_a_seed_loses_the_same_whatever_else_the_conditions_are():
    """And what it lost in earlier versions: a draw for each receiver, of a generator of that seed."""
    n, seed, loss = 300, 7, 0.4
    generator = torch.Generator().manual_seed(seed)
    kept = torch.stack([torch.rand(2, generator=generator, dtype=torch.float64) >= loss for _ in range(n)])
    for others in (
        {},
        {"jitter": 2.0},
        {"duplication": 0.6, "latency": 0.0},
        {"jitter": 0.1, "duplication": 1.0, "bandwidth": 100.0},
        {"reach": 5.0, "partitions": [(1e6, 2e6, [[0]])]},
    ):
        network = network_of(3, loss=loss, seed=seed, **others)
        network.place(on_a_line([0.0, 1.0, 2.0]))
        network.send(0, numbered(n), 0.0, "maps")
        for column, robot in enumerate((1, 2)):
            assert set(heard(network, robot, 1e5)) == {numbered(n)[i] for i in kept[:, column].nonzero()}


@pytest.mark.parametrize("share", [0.05, 0.5])
def test_of_what_is_not_lost_a_share_comes_twice_to_each_receiver_by_itself(share):
    n = 4000
    network = network_of(3, duplication=share, loss=0.2, seed=2)
    network.send(0, numbered(n), 0.0, "maps")
    twice = []
    for robot in (1, 2):
        times = Counter(heard(network, robot))
        assert set(times.values()) == {1, 2}
        twice.append({data for data, k in times.items() if k == 2})
        assert network.reception(robot).duplicated == len(twice[-1])
        assert network.reception(robot).datagrams == times.total()
        assert stats.binomtest(len(twice[-1]), len(times), share).pvalue > UNLIKELY
    assert stats.binomtest(len(twice[0] & twice[1]), n, (0.8 * share) ** 2).pvalue > UNLIKELY
    assert network.traffic() == Traffic(n, 2 * n)


def test_without_jitter_copies_come_together_and_all_in_order():
    network = network_of(2, duplication=1.0)
    network.send(0, numbered(50), 0.0, "maps")
    assert heard(network, 1, 0.05) == [data for data in numbered(50) for _ in range(2)]


def arrival_bins(network: Network, robot: int, edges: list[float]) -> dict[bytes, int]:
    """In which of the bins that end at these times a datagram comes for the first time."""
    found: dict[bytes, int] = {}
    for i, edge in enumerate([*edges, 1e9]):
        for data in heard(network, robot, edge):
            found.setdefault(data, i)
    return found


@pytest.mark.parametrize(("duplication", "mean"), [(0.0, 2.0), (1.0, 1.0)])
def test_jitter_is_exponential_and_of_each_receiver_and_copy_by_itself(duplication, mean):
    """Chi-square in ten bins of equal probability. The sooner of two copies has half the mean."""
    n, latency = 4000, 0.5
    network = network_of(3, latency=latency, jitter=2.0, duplication=duplication, seed=3)
    network.send(0, numbered(n), 10.0, "maps")
    edges = [10.0 + latency - mean * math.log(1 - k / 10) for k in range(1, 10)]
    bins = [arrival_bins(network, robot, edges) for robot in (1, 2)]
    for found in bins:
        assert stats.chisquare([list(found.values()).count(k) for k in range(10)]).pvalue > UNLIKELY
    table = [[0] * 10 for _ in range(10)]
    for data in numbered(n):
        table[bins[0][data]][bins[1][data]] += 1
    assert stats.chi2_contingency(table).pvalue > UNLIKELY
    assert network.n_in_flight == 0


@pytest.mark.parametrize("gap", [0.0, 0.5, 2.0])
def test_how_often_jitter_lets_a_datagram_overtake_the_one_before(gap):
    """P(late₁ > gap + late₂) = ½ exp(−gap / jitter) for exponential times."""
    n, jitter, overtaken = 2000, 1.0, 0
    for sender_pairs in range(n // 100):
        network = network_of(2, jitter=jitter, seed=sender_pairs)
        for i in range(100):
            network.send(0, [bytes([i, 0])], 1000.0 * i, "maps")
            network.send(0, [bytes([i, 1])], 1000.0 * i + gap, "maps")
        order = heard(network, 1)
        overtaken += sum(order.index(bytes([i, 1])) < order.index(bytes([i, 0])) for i in range(100))
    assert stats.binomtest(overtaken, n, math.exp(-gap / jitter) / 2).pvalue > UNLIKELY


# -- partitions and reach ---------------------------------------------------------------------------------


def set_partitions(items: list[int]) -> Iterator[list[list[int]]]:
    """Every way to put items into groups."""
    if not items:
        yield []
        return
    for rest in set_partitions(items[1:]):
        yield [[items[0]], *rest]
        for i, group in enumerate(rest):
            yield [*rest[:i], [items[0], *group], *rest[i + 1 :]]


def test_who_hears_whom_in_every_partition_of_four():
    ways = [groups for groups in set_partitions([0, 1, 2, 3]) if len(groups) > 1]
    assert len(ways) == 14  # Bell's number of 4, less the one that divides nothing
    for groups in ways:
        group_of = {robot: i for i, group in enumerate(groups) for robot in group}
        for named in (groups, groups[1:]):  # those not named are a group of their own
            network = network_of(4, partitions=[(1.0, 2.0, named)])
            for sender in range(4):
                network.send(sender, [bytes([sender])], 1.5, "maps")
            for robot in range(4):
                same = [other for other in group_of if group_of[other] == group_of[robot] and other != robot]
                assert heard(network, robot) == [bytes([other]) for other in sorted(same)]
                assert network.reception(robot).cut_off == 3 - len(same)


def test_what_is_in_the_air_at_the_cut_is_lost_and_what_is_sent_from_its_end_on_arrives():
    """A cut from 3 to 6 s and a flight of a second: at each half second."""
    network = network_of(2, latency=1.0, partitions=[(3.0, 6.0, [[0], [1]])])
    for i in range(20):
        network.send(0, [bytes([i])], i / 2, "maps")
    at_each = [1.5, 2.0, 2.5, 5.5, 6.0]
    arrived = {data[0] / 2 for data in heard(network, 1)}
    assert [time in arrived for time in at_each] == [True, False, False, False, True]
    assert arrived == {i / 2 for i in range(20) if i / 2 + 1 < 3 or i / 2 >= 6}


def test_a_datagram_that_waits_for_its_turn_is_not_in_the_air_yet():
    size = 100 - HEADER_BYTES
    network = network_of(2, latency=0.0, bandwidth=100.0, partitions=[(1.5, 2.0, [[0]])])
    network.send(0, [bytes([i]) * size for i in range(4)], 0.0, "maps")  # a second on the air each
    assert [data[0] for data in heard(network, 1)] == [0, 2, 3]


def test_partitions_may_overlap_and_robots_hear_each_other_if_none_divides_them():
    cuts = [(0.0, 10.0, [[0], [1, 2, 3]]), (5.0, 15.0, [[0, 1], [2, 3]])]
    network = network_of(4, partitions=cuts)
    for now, hear_1 in ((1.0, {2, 3}), (7.0, set()), (12.0, {0}), (20.0, {0, 2, 3})):
        network.send(1, [b"x"], now, "maps")
        assert {robot for robot in (0, 2, 3) if heard(network, robot, now + 0.05)} == hear_1


def test_a_second_copy_may_be_cut_off_alone():
    """Each of a thousand is repeated, and a cut begins while they come."""
    n = 1000
    network = network_of(2, jitter=1.0, duplication=1.0, latency=0.0, partitions=[(1.0, 9e9, [[0]])])
    network.send(0, numbered(n), 0.0, "maps")
    times = Counter(heard(network, 1))
    in_time = 1 - math.exp(-1)
    assert stats.binomtest(len(times), n, in_time).pvalue > UNLIKELY  # the first came in time
    both = sum(k == 2 for k in times.values())
    assert stats.binomtest(both, n, in_time**2).pvalue > UNLIKELY
    r = network.reception(1)
    assert (r.datagrams, r.duplicated) == (len(times) + both, len(times))
    assert r.cut_off == n - len(times) + (len(times) - both)


@given(xs=st.lists(st.floats(-5, 5), min_size=4, max_size=4), reach=st.floats(0.1, 12))
def test_who_is_farther_away_than_the_reach_does_not_hear(xs, reach):
    network = network_of(4, reach=reach)
    positions = torch.tensor([[x, 2 * x, -x] for x in xs], dtype=torch.float64)
    network.place(positions)
    for sender in range(4):
        network.send(sender, [bytes([sender])], 0.0, "maps")
    for robot in range(4):
        apart = [math.sqrt(6) * abs(xs[robot] - x) for x in xs]
        if any(abs(d - reach) < 1e-9 for d in apart):
            return
        near = [other for other in range(4) if other != robot and apart[other] < reach]
        assert heard(network, robot) == [bytes([other]) for other in near]
        assert network.reception(robot).out_of_reach == 3 - len(near)


def test_reach_counts_at_the_time_of_sending_and_to_the_last_metre():
    network = network_of(2, latency=1.0, reach=2.0)
    for i, far in enumerate((2.0, 2.0 + 1e-9, 9.0, 0.0)):
        positions = on_a_line([0.0, far])
        network.place(positions)
        positions[1] += 100.0  # the network has its own
        network.send(0, [bytes([i])], 0.1 * i, "maps")
    network.place(on_a_line([0.0, 99.0]))
    assert heard(network, 1) == [b"\0", b"\3"]


def test_reach_needs_positions_and_nothing_else_does():
    network = network_of(2, reach=5.0)
    with pytest.raises(InvalidArgumentError, match=r"reach=5.0 m needs positions; call place\(\)"):
        network.send(0, [b"x"], 0.0, "maps")
    assert (network.n_datagrams, network.n_in_flight) == (0, 0)
    other = network_of(2)
    other.place(on_a_line([0.0, 1e6]))
    other.send(0, [b"x"], 0.0, "maps")
    assert heard(other, 1) == [b"x"]


@pytest.mark.parametrize(
    "positions",
    [torch.zeros(3, 3), torch.zeros(2), torch.tensor([[0.0, math.nan], [0.0, 1.0]]), torch.zeros(0, 3)],
)
def test_positions_that_cannot_be_are_named(positions):
    with pytest.raises(InvalidArgumentError, match=r"positions of shape .* 2 robots"):
        network_of(2).place(positions)


# -- the books and what is kept ---------------------------------------------------------------------------


@given(sent=sent, conditions=conditions)
def test_the_books_count_broadcasts_once_by_sender_and_kind(sent, conditions):
    network = Network(N, conditions)
    network.place(on_a_line([0.0, 1.0, 2.0]))
    for sender, datagrams, _, kind in sent:
        network.send(sender, datagrams, 0.0, kind)
    for sender in (0, 1, 2, None):
        for kind in ("maps", "plans", None):
            own = [d for s, ds, _, k in sent for d in ds if sender in (None, s) and kind in (None, k)]
            assert network.traffic(sender, kind) == Traffic(len(own), sum(map(len, own)))
    everything = [d for _, ds, _, _ in sent for d in ds]
    assert network.n_datagrams == len(everything)
    assert network.n_bytes == sum(map(len, everything)) == sum(network.bytes_by_kind.values())
    assert network.n_wire_bytes == network.n_bytes + 28 * len(everything)


def test_a_robot_alone_still_pays_for_what_it_sends():
    network = network_of(1, jitter=1.0, loss=0.5, duplication=0.5)
    network.send(0, [b"abc"], 0.0, "maps")
    assert network.deliver(0, 10.0) == []
    assert network.n_bytes == 3
    assert network.reception() == Reception()


# -- what cannot be ---------------------------------------------------------------------------------------

BAD_CONDITIONS = [
    ("latency", [-0.1, math.nan, math.inf, "1", None, True]),
    ("jitter", [-0.1, math.nan, math.inf, "1", None]),
    ("bandwidth", [0.0, -1.0, math.inf, math.nan, "fast"]),
    ("loss", [1.0, -0.1, math.nan, None, "high"]),
    ("duplication", [1.1, -0.1, math.nan, None, "x"]),
    ("reach", [0.0, -1.0, math.inf, math.nan, "far"]),
    ("partitions", [3, None]),
]


@pytest.mark.parametrize(
    ("field", "value"), [(field, value) for field, values in BAD_CONDITIONS for value in values]
)
def test_conditions_that_cannot_be_are_named(field, value):
    with pytest.raises(InvalidArgumentError, match=rf"^{field}={value!r} must be "):
        LinkConditions(**{field: value})
    with pytest.raises(InvalidArgumentError, match=rf"^network\.{field}={value!r} must be "):
        LinkConditions(**{field: value}, names={field: f"network.{field}"})


@pytest.mark.parametrize(
    "bad",
    [
        {},
        {"begin": 1, "end": 2},
        {"begin": 1, "end": 2, "groups": [[0]], "colour": 1},
        {"begin": 2, "end": 1, "groups": [[0]]},
        {"begin": 1, "end": 1, "groups": [[0]]},
        {"begin": math.nan, "end": 1, "groups": [[0]]},
        {"begin": 0, "end": math.inf, "groups": [[0]]},
        {"begin": "0", "end": 1, "groups": [[0]]},
        *[
            {"begin": 0, "end": 1, "groups": groups}
            for groups in ([], [[]], [0, 1], [[0], [0]], [[1, 1]], [[-1]], [[0.5]], [[True]], "ab", ["a"], 3)
        ],
        (1, 2),
        "cut",
        7,
    ],
)
def test_partitions_that_cannot_be_are_named(bad):
    good = {"begin": 1, "end": 2, "groups": [[0]]}
    for name in ("partitions", "network.partitions"):
        with pytest.raises(InvalidArgumentError) as caught:
            LinkConditions(partitions=[good, bad], names={"partitions": name})
        assert str(caught.value).startswith(f"{name}[1]={bad!r} must have begin and end")


@pytest.mark.parametrize(
    ("groups", "message"), [([[0, 2]], "names robot 2; there are 2"), ([[1, 0]], "divides nothing")]
)
def test_partitions_of_another_team_are_named(groups, message):
    conditions = LinkConditions(partitions=[(0, 1, groups)])
    with pytest.raises(InvalidArgumentError, match=r"^partitions\[0\].groups=.*" + message):
        Network(2, conditions)
    with pytest.raises(InvalidArgumentError, match=r"^network.partitions\[0\].groups=.*" + message):
        conditions.check_team(2, {"partitions": "network.partitions"})
    Network(4, conditions)


def test_a_partition_may_be_given_in_any_form():
    forms = [
        Partition(1.0, 2.0, ((0,), (1, 2))),
        {"groups": [[0], [1, 2]], "begin": 1, "end": 2},
        [1, 2, [[0], [1, 2]]],
    ]
    made = [LinkConditions(partitions=[form]) for form in forms]
    assert made[0] == made[1] == made[2]
    assert len(set(made)) == 1  # and hashable
    assert made[0].partitions == (forms[0],)


@pytest.mark.parametrize(
    ("options", "message"),
    [({"n_robots": 0}, "n_robots=0"), ({"n_robots": 2.5}, "n_robots"), ({"seed": -1}, "seed=-1")],
)
def test_networks_that_cannot_be_are_named(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Network(**{"n_robots": 2, **options})


def test_what_cannot_be_sent_is_named_and_not_sent():
    network = Network(2)
    for arguments, message in (
        ((2, [b""], 0.0, "maps"), "sender=2"),
        ((-1, [b""], 0.0, "maps"), "sender=-1"),
        ((0, [b"", bytes(1201)], 0.0, "maps"), "1201 bytes"),
        ((0, ["text"], 0.0, "maps"), "str"),
        ((0, [b""], math.nan, "maps"), "now=nan"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            network.send(*arguments)
    with pytest.raises(InvalidArgumentError, match="robot=2"):
        network.deliver(2, 0.0)
    for robot in (2, -1):
        with pytest.raises(InvalidArgumentError, match=f"robot={robot}"):
            network.reception(robot)
    assert (network.n_datagrams, network.n_in_flight) == (0, 0)
    assert network.reception() == Reception()
