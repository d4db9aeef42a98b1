"""Channels of attributes in messages: what is sent, to whom, and what a map answers from it."""

from __future__ import annotations

import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import assert_same_components
from mapping.random_components import painted, random_components
from sharing.message_examples import sealed
from sharing.replica_histories import exchange, same_attributes, told_twice
from sharing.schedules import Older, act, run_schedule

import gmmtorch as gt
from gmmtorch import Components
from gmmtorch.errors import DataError
from gmmtorch.mapping import Attributes, BitWriter, Labels, Numbers, encode, has_channels, quantized
from gmmtorch.mapping.codec.attribute_block import BLOCK_VERSION
from gmmtorch.mapping.codec.component_batch import decode as decode_batch
from gmmtorch.team.sharing import Broadcast, Replica, Store, decode
from gmmtorch.team.sharing.messages.component_messages import ComponentsMessage, encode_components
from gmmtorch.team.sharing.replica import records

seeds = st.integers(0, 10**6)
COLOURED = b"\x11\x03"
"""How a datagram with channels begins."""
RECORDED = (
    "1102c84830480057740b05b1dd50484ce8b1d8b72fdcc8bb51c58dbb21633b4a77c280fa310b97ef0b22736399a033e2aec66f051d"
    "d91bb549b6b0944fb0889260a14088db8001644ccfeb803679b2599460ffcac154d7ebd1513b91861af5673a4f45f7fc1a9b63fe72"
    "f6744042e0a3f51caf8bc667176602ce37bd17424992a45f0d388390dd49da5483aab53a3c4d19d7c51e4907f82a22973b4d2e92c4"
    "a97a86801f1e33c9"
)
RECORDED_TEAM = (
    "1102c8483048ff00a34e73d903a060143851df2c015f0b968df694d3f43b40152eaff4a6d4559cf250865c84757bc7665bf7f1f9a4"
    "4763e047de128ad364d7841c61e74068db97ff0c03839b1298511d9934aff9cc07d7da6ee4eaa59e939aea2beb6a1e52be07412bc6"
    "5e17d7240ba2afd12b0400e3ef11df6541f00c13dfc3a7dee473eb41340380c0fccd22f530b7d09c6e3bb7f13808e7f6da02c0eb04"
    "a472",
    "1a060e00feffffffffffffff7f02808080808e808030104fa656ef",
)


def nine(seed: int = 4) -> Components:
    return random_components(3, k=9, seed=seed, extent=8.0)


def test_without_attributes_no_byte_differs_from_earlier_versions():
    """Bytes and digest that the version before channels wrote; its announcement said the same at length."""
    assert [d.hex() for d in encode_components(nine())] == [RECORDED]
    replica = Replica(3, incarnation=7)
    replica.add(nine())
    *records, recorded = RECORDED_TEAM
    assert [d.hex() for d in replica.datagrams()] == records
    (announced,) = replica.announcements()
    assert vars(decode(announced)) == vars(decode(bytes.fromhex(recorded)))
    assert replica.digest().hex() == "7f6f9d3f5c5ea27322721587831060df"


@settings(max_examples=20, deadline=None)
@given(
    dim=st.sampled_from([2, 3]),
    k=st.integers(1, 300),
    seed=seeds,
    n_labels=st.sampled_from([1, 2, 3, 40, 300]),
)
def test_a_receiver_has_the_rounded_attributes(dim, k, seed, n_labels):
    given_ones = painted(random_components(dim, k=k, seed=seed, extent=8.0), seed, n_labels)
    datagrams = encode_components(given_ones)
    assert max(map(len, datagrams)) <= 1200
    found = [decode(datagram) for datagram in datagrams]
    assert all(isinstance(message, ComponentsMessage) for message in found)
    whole = Components.concatenate([message.components for message in found])
    expected = quantized(given_ones)
    assert torch.equal(whole.means, expected.means)
    assert same_attributes(whole, expected)


@pytest.mark.parametrize("seed", range(3))
def test_rounding_a_batch_again_in_any_grouping_changes_nothing(seed):
    once = decode_batch(encode(painted(nine(seed), seed), channels=True))
    rows = torch.randperm(9, generator=torch.Generator().manual_seed(seed))
    for part in rows.split(4):
        again = decode_batch(encode(once.selected(part), channels=True))
        assert same_attributes(again, once.selected(part))


# -- teams -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("painters", "older"), [(3, 0), (1, 0), (2, 1), (1, 2)])
@pytest.mark.parametrize("seed", range(2))
def test_all_replicas_agree_once_the_network_heals(seed, painters, older):
    """With loss, repetition, reordering, partitions and restarts, and robots that know no channels."""
    outcome = run_schedule(seed, n_robots=3, painters=painters, older=older)
    assert outcome.converged
    assert outcome.complete
    assert outcome.refused.keys() <= {"own"}
    newer = [replica for replica in outcome.replicas if type(replica) is Replica]
    for replica in outcome.replicas:
        assert_same_components(bare(newer[0].components()), bare(replica.components()))
    for replica in newer:
        assert same_attributes(newer[0].components(), replica.components())
    assert not any(replica.components().attributes for replica in outcome.replicas if type(replica) is Older)


def bare(components: Components) -> Components:
    return replace(components, attributes=Attributes())


@settings(max_examples=6, deadline=None)
@given(seed=seeds, order=st.randoms(use_true_random=False))
def test_order_and_repetition_do_not_matter(seed, order):
    """Also if some components arrive without their channels before or after."""
    rng = random.Random(seed)
    robot = Replica(0)
    sent: list[bytes] = []
    for _ in range(6):
        act(rng, robot, paints=True)
        sent += robot.datagrams()
    for datagram in list(sent):
        if datagram[:2] == COLOURED and order.random() < 0.5:
            sent += encode_components(bare(decode(datagram).components))
    one, _ = told_twice(sent, order)
    assert one.digest() == robot.digest()
    assert same_attributes(one.components(), robot.components())


def test_the_map_of_a_receiver_answers_like_that_of_the_sender():
    scans = gt.datasets.load("synthetic_building_2d", n_scans=8)
    made = gt.GaussianMap(resolution=0.2, robot=1)
    for scan in scans:
        y = scan.points[:, 1].double()
        colour = torch.stack([0.5 + 0.2 * torch.tanh(y), 0.5 - 0.2 * torch.tanh(y), 0.2 + 0 * y], 1)
        made.insert(replace(scan, attributes={"colour": colour, "class": (y > 0).long()}))
    made.finish()
    sender, receiver = Replica(1), Replica(2)
    sender.add(made)
    exchange([sender, receiver])
    points = scans[0].points
    given_ones, found = made.attributes(points), receiver.map(resolution=0.2).attributes(points)
    assert given_ones.keys() == found.keys() == {"colour", "class"}
    assert torch.equal(given_ones["colour"].known, found["colour"].known)
    # A map is rounded when it learns, so the receiver has its values.
    torch.testing.assert_close(given_ones["colour"].mean, found["colour"].mean, atol=1e-9, rtol=0)
    assert torch.equal(given_ones["class"].most_likely, found["class"].most_likely)


def test_a_robot_shares_the_channels_that_are_chosen():
    sender, receiver = Replica(0, channels=["class"]), Replica(1)
    sender.add(painted(nine()))
    exchange([sender, receiver])
    assert set(receiver.components().attributes.channels) == {"class"}


def test_a_robot_of_an_earlier_version_gets_the_geometry_and_others_the_channels():
    painter, older, late = Replica(0), Older(1), Replica(2)
    painter.add(painted(nine()))
    first = painter.datagrams()
    assert all(datagram[:2] == COLOURED for datagram in first)
    assert not any(older.receive(datagram) for datagram in first)
    exchange([painter, older])
    assert_same_components(bare(painter.components()), older.components())
    exchange([older, late])  # which has nothing from the painter yet
    assert len(late.components()) == 9
    assert not late.components().attributes
    exchange([painter, late])
    assert same_attributes(late.components(), painter.components())
    assert late.digest() == painter.digest()
    late.changes()
    exchange([painter, older, late])
    sent = [datagram for robot in (painter, older, late) for datagram in robot.datagrams()]
    assert sent == []  # nothing is due for ever


def test_bytes_of_a_colour_and_of_a_class():
    """Over datagrams of as many components as fit; the bytes of the geometry are those without attributes."""
    scans = gt.datasets.load("synthetic_building", n_scans=6)
    parts = {}
    for name in ("none", "colour", "class"):
        made = gt.GaussianMap()
        for scan in scans:
            x, y, _ = scan.points.double().T
            generator = torch.Generator().manual_seed(0)
            noise = 0.05 * torch.randn(len(x), 3, generator=generator, dtype=torch.float64)
            colour = torch.stack([x.sin(), y.cos(), (x + y).sin()], 1) * 0.3 + 0.5 + noise
            known = {"colour": colour.clamp(0, 1), "class": x.long().abs() % 5, "none": None}[name]
            made.insert(replace(scan, attributes={} if known is None else {name: known}))
        made.finish()
        replica = Replica(0)
        replica.add(made)
        parts[name] = replica.datagrams(), len(made.components())
    k = parts["none"][1]
    assert {n for _, n in parts.values()} == {k}
    size = {name: sum(map(len, datagrams)) / k for name, (datagrams, _) in parts.items()}
    assert k > 300
    assert size["colour"] - size["none"] <= 4.0
    assert size["class"] - size["none"] <= 1.0


# -- what does not fit -----------------------------------------------------------------------------


def with_channel(channel: Numbers | Labels, name: str = "heat") -> Components:
    return replace(nine(), attributes=Attributes({name: channel}))


def numbers(width: int) -> Numbers:
    return Numbers(
        torch.ones(9).double(), torch.ones(9, width).double(), torch.zeros(9, width, 3).double(),
        torch.eye(width).double().expand(9, -1, -1),
    )  # fmt: skip


def test_a_channel_with_other_columns_is_left_out_and_the_geometry_is_not(caplog):
    one, other, third = Replica(0), Replica(1), Replica(2)
    one.add(with_channel(numbers(1)))
    other.add(with_channel(numbers(2)))
    exchange([one, other, third])
    for replica in (one, other, third):
        assert len(replica.components()) == 18
        assert not replica.missing
        replica.map()
    assert "heat" in caplog.text


def test_other_robots_cannot_fill_the_memory_with_labels_and_channels(monkeypatch):
    monkeypatch.setattr(records, "MOST_LABELS", 12)
    attacker, robot = Replica(0), Replica(1)
    monkeypatch.setattr(attacker._records, "fitting", lambda components: components)
    labels = [Labels(torch.eye(9).double(), torch.arange(9) + 9 * n) for n in range(4)]
    sent = []
    for number, one in enumerate(labels):
        attacker.add(with_channel(one))
        sent += attacker.datagrams()
        attacker.add(with_channel(numbers(1), f"x{number}"))
    for number in range(20):
        attacker.add(with_channel(numbers(1), f"y{number}"))
    for datagram in sent + attacker.datagrams():
        assert robot.receive(datagram)
    found = robot.components()
    assert len(found) == 28 * 9
    assert len(found.attributes.channels) == 16
    assert len(found.attributes.channels["heat"].labels) == 9


def test_two_colours_of_one_record_are_a_duplicate_id():
    one, other, witness = Replica(0, incarnation=1), Replica(0, incarnation=1), Replica(2)
    one.add(painted(nine(), 1))
    other.add(painted(nine(), 2))
    assert all(map(witness.receive, one.datagrams()))
    assert not any(map(witness.receive, other.datagrams()))
    assert witness.duplicates[0]


def test_a_block_with_more_values_than_a_message_may_have_is_refused():
    """A few bytes announce 1024 components with 65 536 labels each."""
    batch, size, block = encode(random_components(3, k=200)), BitWriter(), BitWriter()
    size.number(len(batch) - 4)
    for number in (1, 1):
        block.number(number)
    block.one(ord("x"), 8)
    for number in (0, 65536):
        block.number(number)
    body = b"\x03" + size.to_bytes() + batch[:-4] + bytes([BLOCK_VERSION]) + block.to_bytes()
    with pytest.raises(DataError, match="too many"):
        decode_batch(sealed(body), 1024)


# -- stored ----------------------------------------------------------------------------------------


def test_a_store_keeps_channels_that_arrive_after_the_geometry(tmp_path):
    painter = Replica(0)
    painter.add(painted(nine()))
    (coloured,) = painter.datagrams()
    (plain,) = encode_components(bare(decode(coloured).components))
    path, late = tmp_path / "robot.sqlite", Replica(1)
    store = Store(path, robot=1)
    store.restore(late)
    for datagram in (plain, coloured, coloured):
        assert late.receive(datagram)
        assert store.keep([datagram])
    n_rows = store._db.execute("SELECT count(*) FROM record").fetchone()[0]
    store._db.close()  # as if the process were killed
    assert n_rows == 2
    again = Replica(1)
    with Store(path, robot=1) as store:
        store.restore(again)
        assert again.digest() == late.digest()
    assert same_attributes(again.components(), painter.components())


def test_broadcast_shares_the_geometry_alone():
    sender, receiver = Broadcast(0, "quantized"), Broadcast(1, "quantized")
    sender.add(painted(nine()))
    for datagram in sender.datagrams():
        assert not has_channels(datagram[1:])
        receiver.receive(datagram)
    assert len(receiver.components()) == 9
