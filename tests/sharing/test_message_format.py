"""Messages of views and plans, the kinds, and the format by hand from docs/messages.md."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from invalid_values import each_value
from sharing.message_examples import examples, numbers, places, sealed, views

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.sharing.messages.envelope import FARTHEST, VERSION, Kind
from gmmtorch.team.sharing.messages.message_registry import (
    MAX_BYTES,
    PlanMessage,
    decode,
    encode_counts,
    encode_plan,
    encode_views,
    kind_of,
    quantized_poses,
)
from gmmtorch.team.sharing.replica.record_keys import Intervals

# -- views and plans -------------------------------------------------------------------------------


@given(poses=st.lists(st.tuples(*[st.floats(-FARTHEST, FARTHEST)] * 3, st.floats(-1e3, 1e3)), max_size=20))
def test_pose_quantization_is_close_and_idempotent(poses):
    rows = torch.tensor(poses, dtype=torch.float64).reshape(-1, 4)
    found = quantized_poses(rows)
    assert float((found[:, :3] - rows[:, :3]).abs().max() if len(rows) else 0) <= 0.005 + 1e-7
    turned = torch.remainder(found[:, 3] - rows[:, 3] + math.pi, 2 * math.pi) - math.pi
    assert float(turned.abs().max() if len(rows) else 0) <= math.pi / 256 + 1e-9
    assert bool(((found[:, 3] >= -math.pi) & (found[:, 3] < math.pi)).all())
    assert torch.equal(quantized_poses(found), found)


def test_poses_in_whole_centimetres_are_decoded_exactly():
    poses = torch.tensor(
        [[0.29, -1.15, 4.35, math.pi / 2], [500000.07, 0.0, 0.01, -math.pi]], dtype=torch.float64
    )
    assert torch.equal(quantized_poses(poses), poses)


@given(
    n=st.integers(0, 3) | st.integers(0, 250),
    n_removed=st.integers(0, 3) | st.integers(0, 250),
    seed=st.integers(0, 99),
    center=places,
)
def test_views_are_decoded_within_their_step(n, n_removed, seed, center):
    sent = views(n, n_removed, seed, center)
    datagrams = encode_views(sent)
    assert bool(datagrams) == bool(n + n_removed)
    assert all(len(datagram) <= MAX_BYTES for datagram in datagrams)
    found = [decode(datagram) for datagram in datagrams]
    order = sorted(range(n), key=lambda row: sent.ids[row].tolist())
    for name in ("ids", "poses", "values", "stamps") if n else ():
        assert torch.equal(torch.cat([getattr(m, name) for m in found]), getattr(sent, name)[order]), name
    removed = Intervals.empty()
    for message in found:
        removed |= message.removed
    assert removed == sent.removed


def test_a_view_takes_few_bytes():
    assert len(encode_views(views(50))[0]) <= 11 * 50
    assert len(encode_views(views(0, 100))[0]) <= 2 * 100 + 20
    assert len(encode_views(replace(views(0), removed=Intervals.span(5, 500_000)))[0]) <= 13


INVALID_VIEWS = {
    "ids": [
        torch.tensor([[0, 1], [0, 1]]),
        torch.tensor([[0, -1], [0, 1]]),
        torch.tensor([[0, 1 << 60], [0, 1]]),
        torch.tensor([[0.0, 1.0], [0.0, 2.0]]),
        torch.tensor([[1024, 1], [0, 1]]),
    ],
    "removed": [Intervals.span(-5, 5), Intervals.span(5, (1 << 62) + 1)],
    "poses": [*(torch.full((2, 4), x) for x in (math.nan, 1e9, 1.01 * FARTHEST)), torch.zeros(2, 3)],
    "values": [torch.tensor([1.0, 7e4]), torch.tensor([1.0, math.nan])],
    "stamps": [torch.tensor([1.0, math.inf]), torch.zeros(3)],
}


@pytest.mark.parametrize(("name", "value"), each_value(INVALID_VIEWS))
def test_invalid_views_are_refused(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        encode_views(replace(views(2, 2), **{name: value}))


@given(
    sender=numbers,
    number=numbers,
    time=st.integers(0, 10**9),
    step=st.integers(1, 10**4),
    n=st.integers(0, 60),
    n_views=st.integers(0, 20),
    speed=st.floats(0, 2),
)
def test_plans_are_decoded_within_their_step(sender, number, time, step, n, n_views, speed):
    along = torch.arange(n, dtype=torch.float64) * 0.2
    path = torch.stack([speed * along, 3 - along, along * 0 + 1.5, 1.2 * along], 1)
    (datagram,) = encode_plan(sender, number, time / 1000, step / 1000, path, views(n_views).poses)
    found = decode(datagram)
    assert isinstance(found, PlanMessage)
    assert (found.sender, found.number, found.time, found.step) == (sender, number, time / 1000, step / 1000)
    assert torch.equal(found.path, quantized_poses(path))
    assert torch.equal(found.views, views(n_views).poses)


def test_a_plan_of_four_seconds_is_short():
    along = torch.arange(20, dtype=torch.float64) * 0.2
    path = torch.stack([along.cos() * 3, along.sin() * 3, 1 + 0.1 * along, along + math.pi / 2], 1)
    assert len(encode_plan(1, 17, 842.0, 0.2, path)[0]) <= 60


def test_invalid_plans_are_refused():
    path = torch.zeros(4, 4)
    for changed, message in (
        ({"step": 0.0}, "step=0.0"),
        ({"step": math.nan}, "step"),
        ({"time": math.inf}, "time"),
        ({"number": -1}, "number=-1"),
        ({"sender": 1 << 60}, "sender"),
        ({"path": torch.full((2, 4), math.inf)}, "path"),
        ({"path": torch.zeros(1001, 4)}, "1001 poses"),
        ({"path": torch.rand(900, 4, dtype=torch.float64) * 1e6}, "room for 1200"),
        ({"views": torch.zeros(2, 3)}, "views"),
    ):
        sound = {"sender": 1, "number": 2, "time": 3.0, "step": 0.2, "path": path, "views": path}
        with pytest.raises(InvalidArgumentError, match=message):
            encode_plan(**{**sound, **changed})


# -- the format, by hand from docs/messages.md -----------------------------------------------------


def test_a_counts_message_equals_bytes_by_hand():
    """From robot 1: components 3 and 5 of robot 0 gained a point each."""
    stream = "00000010" + "00000010" + "00000000" + "00000100" + "00000110"  # sender; robots; 0, two ids, 3
    stream += "000000" + "01"  # b = 0; a gap of 2, less one
    stream += "00" + "000000" + "00000000"  # a column of no bits each, all 0: log2 of 1
    body = int(stream, 2).to_bytes(len(stream) // 8, "big")
    datagram = sealed(b"\x14" + body)
    message = decode(datagram)
    assert (message.sender, message.counts) == (1, {(0, 3): 1.0, (0, 5): 1.0})
    assert encode_counts(1, {(0, 5): 1.0, (0, 3): 1.0}) == [datagram]


def test_a_path_message_equals_bytes_by_hand():
    """Two poses of robot 0, a metre apart, the second turned right by 45°; no views."""
    poses = torch.tensor([[0.0, 0.01, 0.0, 0.0], [1.0, 0.01, 0.0, -math.pi / 4]], dtype=torch.float64)
    stream = "".join(f"{byte:08b}" for byte in (0, 2, 2, 4, 4))  # robot 0, plan 1, 1 ms, 2 ms, 2 poses
    fixed = "00" + "000000"  # a column of one number is its base
    stream += "00000000" + fixed + "11001000" + "00000001"  # x: 0, then 100 = 200 zigzag = 72 + 128 · 1
    stream += "00000010" + fixed + "00000000" + "00000000" + fixed + "00000000"
    stream += "00000000" + fixed + f"{2 * 32 - 1:08b}"  # yaw: 0, then -32 of 256
    stream += "00000000"  # no views
    datagram = sealed(b"\x19" + int(stream, 2).to_bytes(len(stream) // 8, "big"))
    assert encode_plan(0, 1, 0.001, 0.002, poses) == [datagram]
    assert torch.equal(decode(datagram).path, poses)


def test_a_points_message_equals_bytes_by_hand():
    body = struct.pack("<HI3dHHH6fB", 7, 9, 500.0, 0.5, 1.0, 1, 3, 2, 1, 2, 3, -1, -2, -3, 0b01000000)
    message = decode(sealed(b"\x17" + body))
    assert (message.sender, message.frame, message.part, message.n_parts) == (7, 9, 1, 3)
    assert message.ends.tolist() == [[501.0, 2.5, 4.0], [499.0, -1.5, -2.0]]
    assert message.is_hit.tolist() == [False, True]


# -- kinds -----------------------------------------------------------------------------------------


def test_every_message_kind_has_a_name():
    """In the order of the kinds, so that a new kind needs a name here."""
    names = (
        ["calibrations"] + ["components"] * 3 + ["counts"] * 3 + ["points", "views", "plans", "announcements"]
    )
    names += ["supersessions", "counts", "corrections", "frames"]
    assert [kind_of(bytes([VERSION << 4 | kind])) for kind in sorted(Kind)] == names
    assert [kind_of(datagram) for datagram in examples()] == [*names[1:], names[0]]
