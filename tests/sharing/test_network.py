"""The simulated network: which datagrams arrive where and when, and their statistics."""

from __future__ import annotations

import math
from collections import Counter
from typing import Any

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from invalid_values import each_value
from scipy import stats

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing.transport.link_conditions import LinkConditions, Partition
from gmmtorch.team.sharing.transport.simulated_network import Network, Reception, Traffic

N = 3
UNLIKELY = 1e-4  # seeds are fixed, so that results are reproducible

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


def received(network: Network, robot: int, now: float = 1e9) -> list[bytes]:
    return [data for _, data in network.deliver(robot, now)]


# -- brute-force model -----------------------------------------------------------------------------------


class Model:
    """The network in plain Python: a list of all copies, and links evaluated at every instant at which they
    may change. Its random numbers equal those of a network with the same seed."""

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


@settings(max_examples=50)
@given(conditions=conditions, sent=sent, walks=walks, seed=st.integers(0, 9))
def test_deliveries_equal_a_brute_force_model(conditions, sent, walks, seed):
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


# -- jitter, by its distribution ---------------------------------------------------


def arrival_bins(network: Network, robot: int, edges: list[float]) -> dict[bytes, int]:
    """The bin, of those that end at these times, in which each datagram first arrives."""
    found: dict[bytes, int] = {}
    for i, edge in enumerate([*edges, 1e9]):
        for data in received(network, robot, edge):
            found.setdefault(data, i)
    return found


@pytest.mark.parametrize(("duplication", "mean"), [(0.0, 2.0), (1.0, 1.0)])
def test_jitter_is_exponential_and_independent(duplication, mean):
    """Chi-square test in ten bins of equal probability. The earlier of two copies has half the mean."""
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


# -- partitions and reach --------------------------------------------------------------------------------


def test_only_reach_needs_positions():
    network = network_of(2, reach=5.0)
    with pytest.raises(InvalidArgumentError, match=r"reach=5.0 m needs positions; call place\(\)"):
        network.send(0, [b"x"], 0.0, "maps")
    assert network.traffic().datagrams == 0
    other = network_of(2)
    other.place(on_a_line([0.0, 1e6]))
    other.send(0, [b"x"], 0.0, "maps")
    assert received(other, 1) == [b"x"]


@pytest.mark.parametrize(
    "positions",
    [torch.zeros(3, 3), torch.zeros(2), torch.tensor([[0.0, math.nan], [0.0, 1.0]]), torch.zeros(0, 3)],
)
def test_invalid_positions_are_named(positions):
    with pytest.raises(InvalidArgumentError, match=r"positions of shape .* 2 robots"):
        network_of(2).place(positions)


# -- statistics ------------------------------------------------------------------------------------------


@given(sent=sent, conditions=conditions)
def test_traffic_counts_each_broadcast_once_by_sender_and_kind(sent, conditions):
    network = Network(N, conditions)
    network.place(on_a_line([0.0, 1.0, 2.0]))
    for sender, datagrams, _, kind in sent:
        network.send(sender, datagrams, 0.0, kind)
    for sender in (0, 1, 2, None):
        for kind in ("maps", "plans", None):
            own = [d for s, ds, _, k in sent for d in ds if sender in (None, s) and kind in (None, k)]
            assert network.traffic(sender, kind) == Traffic(len(own), sum(map(len, own)))
    everything = [d for _, ds, _, _ in sent for d in ds]
    assert network.traffic().bytes == sum(network.bytes_by_kind.values())
    assert network.traffic().wire_bytes == network.traffic().bytes + 28 * len(everything)


# -- invalid input ---------------------------------------------------------------------------------------

BAD_CONDITIONS = {
    "latency": [-0.1, math.nan, math.inf, "1", None],
    "jitter": [-0.1, math.nan, math.inf, "1", None],
    "bandwidth": [0.0, -1.0, math.inf, math.nan, "fast"],
    "loss": [1.0, -0.1, math.nan, None, "high"],
    "duplication": [1.1, -0.1, math.nan, None, "x"],
    "reach": [0.0, -1.0, math.inf, math.nan, "far"],
    "partitions": [3, None],
}


@pytest.mark.parametrize(("field", "value"), each_value(BAD_CONDITIONS))
def test_invalid_conditions_are_named(field, value):
    with pytest.raises(InvalidArgumentError, match=rf"^{field}={value!r} must be "):
        LinkConditions(**{field: value})


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
def test_invalid_partitions_are_named(bad):
    good = {"begin": 1, "end": 2, "groups": [[0]]}
    with pytest.raises(InvalidArgumentError) as caught:
        LinkConditions(partitions=[good, bad])
    assert str(caught.value).startswith(f"partitions[1]={bad!r} must have begin and end")
    assert caught.value.argument == "partitions"


@pytest.mark.parametrize(
    ("groups", "message"), [([[0, 2]], "names robot 2; there are 2"), ([[1, 0]], "divides nothing")]
)
def test_partitions_of_other_robots_are_named(groups, message):
    conditions = LinkConditions(partitions=[(0, 1, groups)])
    with pytest.raises(InvalidArgumentError, match=r"^partitions\[0\].groups=.*" + message):
        Network(2, conditions)
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
def test_invalid_networks_are_named(options, message):
    with pytest.raises(InvalidArgumentError, match=message):
        Network(**{"n_robots": 2, **options})


def test_invalid_datagrams_are_named_and_not_sent():
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
    assert network.traffic().datagrams == 0
    assert network.reception() == Reception()
