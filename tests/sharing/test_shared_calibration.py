"""Calibrations of a team: the latest of each robot counts, in any order, and maps answer by their mean."""

from __future__ import annotations

import itertools
import random
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.random_components import random_components

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.occupancy.calibrator import Calibration, Calibrator
from gmmtorch.team.sharing import Replica, decode
from gmmtorch.team.sharing.messages.record_messages import CalibrationMessage, encode_record
from gmmtorch.team.sharing.replica.record_keys import first_key


def learned(n_predicted: int, shift: float = 0.0, mean_range: float = 12.0) -> Calibration:
    """A calibration as a map states it."""
    start = Calibrator.of(mean_range, 3)
    return replace(start, mean=start.mean + shift, n_predicted=n_predicted).calibration


def said(robot: int, *calibrations: Calibration, incarnation: int = 1) -> list[bytes]:
    """The datagrams of a robot that writes calibrations one after another."""
    replica, datagrams = Replica(robot, incarnation=incarnation), []
    for one in calibrations:
        replica.calibrate(one)
        datagrams += replica.datagrams()
    return datagrams


def listener(datagrams: list[bytes]) -> Replica:
    replica = Replica(9, incarnation=1)
    assert all(replica.receive(datagram) for datagram in datagrams)
    return replica


def test_a_team_without_calibrations_has_none():
    assert Replica(0).calibration is None


def test_the_calibration_of_a_team_is_the_mean_by_predictions():
    mine, other = learned(900, 0.1), learned(300, -0.1)
    team = listener(said(1, mine) + said(2, other))
    assert team.calibration == Calibration.merged([mine, other])
    assert mine.coefficients > team.calibration.coefficients > other.coefficients


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10**6))
def test_order_repetition_and_loss_of_older_records_do_not_matter(seed):
    steps = [learned(n, 1e-4 * n) for n in (24, 40, 300, 4000)]
    newest = said(1, *steps)[-2:]  # the last record, and the supersession of those before
    every = said(1, *steps) + said(2, learned(700, 0.2)) + said(3, *steps[:2], incarnation=4)
    fewer = newest + said(2, learned(700, 0.2)) + said(3, *steps[:2], incarnation=4)
    rng = random.Random(seed)
    shuffled = rng.sample(every, len(every)) + rng.choices(every, k=5)
    one, other, rest = listener(every), listener(shuffled), listener(fewer)
    assert one.digest() == other.digest()
    assert one.calibration == other.calibration == rest.calibration
    assert one.calibration == Calibration.merged([steps[3], learned(700, 0.2), steps[1]])


def test_a_calibration_is_written_again_after_many_more_predictions_only():
    assert len(said(1, *[learned(n) for n in range(24, 10_000, 24)])) < 40
    replica = Replica(1)
    replica.calibrate(learned(1000))
    replica.datagrams()
    replica.calibrate(learned(1200))
    assert replica.datagrams() == []
    assert replica.calibration == learned(1000)


def test_a_robot_that_starts_again_supersedes_what_it_said_before():
    replica = Replica(1, incarnation=1)
    replica.calibrate(learned(100))
    again = Replica(1, incarnation=2)
    assert again.load(*replica.stored()) == 0
    again.calibrate(learned(120))  # not many more
    assert again.calibration == learned(100)
    again.calibrate(learned(500, 0.1))
    assert again.calibration == learned(500, 0.1)
    assert len(again.stored()[1]) == 2  # the record and the supersession


def test_a_shared_map_answers_by_the_calibration_of_its_team():
    components = random_components(3, k=20)
    built = GaussianMap.of(components, calibration=learned(5000, 0.3), robot=0)
    replica = Replica(0)
    replica.add(GaussianMap.of(replace(components, ids=components.ids * torch.tensor([0, 1])), robot=0))
    assert replica.map().query_options.calibration is None
    replica.calibrate(learned(5000, 0.3))
    assert replica.map().query_options.calibration == built.query_options.calibration == learned(5000, 0.3)
    points = components.means + 0.01
    assert torch.equal(
        replica.map().occupancy(points), built.snapshot(replica.components()).occupancy(points)
    )
    by_counts = replica.map(prior=1.0)
    assert by_counts.query_options.prior == 1.0
    assert not torch.equal(by_counts.occupancy(points), built.occupancy(points))


def test_adding_a_map_writes_its_calibration():
    components = random_components(3, k=5)
    built = GaussianMap.of(replace(components, ids=components.ids * torch.tensor([0, 1])), robot=0)
    replica = Replica(0)
    replica.add(built)
    assert replica.calibration is None
    replica.add(built.snapshot(calibration=learned(60)))
    assert replica.calibration == learned(60)


@pytest.mark.parametrize(
    ("change", "place"), list(itertools.product([0x7C00, 0x7E00, 0xFC00, 0x7BFF], [0, 1, 2, 13]))
)
def test_a_damaged_calibration_is_refused(change, place):
    data = bytearray(learned(100).to_bytes())
    data[2 * place : 2 * place + 2] = change.to_bytes(2, "little")  # ±infinity, NaN, too large
    with pytest.raises(DataError, match="calibration is damaged"):
        Calibration.of_bytes(bytes(data))


def test_a_calibration_that_no_datagram_can_hold_is_refused():
    for bad in (
        learned(100)._replace(length=1.0 / 3),
        learned(100)._replace(length=float("nan")),
        learned(100)._replace(coefficients=(float("inf"),) * 12),
        learned(100)._replace(n_predicted=-5),
    ):
        with pytest.raises(InvalidArgumentError, match="has the calibration"):
            encode_record(CalibrationMessage(first_key(1), bad))


def test_the_record_is_short_and_decodes_to_itself():
    datagram = encode_record(CalibrationMessage(first_key(3, 7) + 5, learned(12_345)))
    assert len(datagram) <= 64
    found = decode(datagram)
    assert isinstance(found, CalibrationMessage)
    assert (found.key, found.calibration) == (first_key(3, 7) + 5, learned(12_345))
