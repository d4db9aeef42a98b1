"""The simulated network: who hears what, when, and what it costs."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.exploration.checkpoint import load_checkpoint, save_checkpoint
from gmmtorch.sharing.network import HEADER_BYTES, Network, Traffic

sent = st.lists(
    st.tuples(
        st.integers(0, 2),  # sender
        st.lists(st.binary(max_size=40), max_size=4),
        st.floats(0, 3),  # seconds since the last
        st.sampled_from(["maps", "plans"]),
    ),
    max_size=25,
)


def test_all_but_the_sender_hear_a_datagram_once_after_the_latency():
    network = Network(3, latency=0.5)
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
    network = Network(3, latency=0.0, bandwidth=100.0)
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
    network, now = Network(3, latency, bandwidth), 0.0
    expected, free = [], [0.0] * 3
    for sender, datagrams, pause, kind in sent:
        now += pause
        network.send(sender, datagrams, now, kind)
        for data in datagrams:
            free[sender] = max(now, free[sender]) + (0 if bandwidth is None else (len(data) + 28) / bandwidth)
            expected.append((free[sender] + latency, len(expected), sender, data))
    middle, end = now / 2 + latency, 1e9
    for robot in range(3):
        of_others = [a for a in sorted(expected) if a[2] != robot]
        early = network.deliver(robot, middle)
        assert early == [(sender, data) for time, _, sender, data in of_others if time <= middle]
        assert early + network.deliver(robot, end) == [(sender, data) for _, _, sender, data in of_others]


def test_what_is_lost_is_lost_to_each_receiver_by_itself():
    n, loss = 4000, 0.3
    network = Network(3, loss=loss, seed=5)
    network.send(0, [i.to_bytes(2, "little") for i in range(n)], 0.0, "maps")
    heard = [{data for _, data in network.deliver(robot, 1.0)} for robot in (1, 2)]
    error = math.sqrt(loss * (1 - loss) / n)
    for each in heard:
        assert abs(len(each) / n - (1 - loss)) < 4 * error
    assert abs(len(heard[0] & heard[1]) / n - (1 - loss) ** 2) < 4 * error
    assert network.traffic() == Traffic(n, 2 * n)  # sent all the same, and once


def test_the_seed_decides_what_is_lost():
    def heard(seed: int) -> list[tuple[int, bytes]]:
        network = Network(2, loss=0.5, seed=seed)
        network.send(0, [bytes([i]) for i in range(64)], 0.0, "maps")
        return network.deliver(1, 1.0)

    assert heard(1) == heard(1)
    assert heard(1) != heard(2)


@given(sent=sent)
def test_the_books_count_broadcasts_once_by_sender_and_kind(sent):
    network = Network(3, loss=0.5)
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


@settings(max_examples=40)
@given(
    before=sent,
    after=sent,
    loss=st.sampled_from([0.0, 0.4]),
    bandwidth=st.sampled_from([None, 50.0]),
    seed=st.integers(0, 9),
)
def test_a_restored_network_goes_on_as_if_nothing_had_come_between(
    tmp_path, before, after, loss, bandwidth, seed
):
    def go_on(network: Network, now: float) -> list[object]:
        seen: list[object] = [network.deliver(robot, now) for robot in range(3)]
        for sender, datagrams, pause, kind in after:
            now += pause
            network.send(sender, datagrams, now, kind)
            seen.append(network.deliver((sender + 1) % 3, now))
        seen += [network.deliver(robot, 1e9) for robot in range(3)]
        return [*seen, network.bytes_by_kind, network.n_wire_bytes]

    network, now = Network(3, 0.5, bandwidth, loss, seed), 0.0
    for sender, datagrams, pause, kind in before:
        now += pause
        network.send(sender, datagrams, now, kind)
        network.deliver(0, now)
    state = load_checkpoint(save_checkpoint(tmp_path / "network", network.state()))
    other = Network(3, 0.5, bandwidth, loss, seed + 1)
    other.send(0, [b"forgotten"], 0.0, "maps")
    other.restore(state)
    assert go_on(other, now) == go_on(network, now)


def test_what_was_delivered_is_forgotten():
    network = Network(2)
    sizes = []
    for tick in range(50):
        network.send(0, [bytes(1000)], float(tick), "maps")
        network.deliver(1, float(tick) + 0.5)
        sizes.append(network.state()["payload"].numel())
    assert network.n_in_flight == 0
    assert max(sizes) == sizes[0] <= 1


def test_a_robot_alone_still_pays_for_what_it_sends():
    network = Network(1)
    network.send(0, [b"abc"], 0.0, "maps")
    assert network.deliver(0, 10.0) == []
    assert network.n_bytes == 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"n_robots": 0}, "n_robots=0"),
        ({"n_robots": 2.5}, "n_robots"),
        ({"latency": -0.1}, "latency=-0.1"),
        ({"latency": math.nan}, "latency=nan"),
        ({"bandwidth": 0.0}, "bandwidth=0.0"),
        ({"bandwidth": math.inf}, "bandwidth=inf"),
        ({"loss": 1.0}, "loss=1.0"),
        ({"loss": -0.1}, "loss=-0.1"),
        ({"loss": math.nan}, "loss=nan"),
        ({"seed": -1}, "seed=-1"),
    ],
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
    with pytest.raises(InvalidArgumentError, match="3 robots"):
        network.restore(Network(3).state())
    assert (network.n_datagrams, network.n_in_flight) == (0, 0)
    assert isinstance(network.state()["generator"], torch.Tensor)
