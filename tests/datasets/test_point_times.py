"""Times of points in every form, right and wrong: points of a moving robot lie on the walls, or are counted.

The room is a box. The robot drives and turns in it; TF states its poses at 50 Hz.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.datasets import Dataset, Rate, load
from gmmtorch.datasets.ros.point_times import PointTimes

pytest.importorskip("rosbags")

from sensor_bags import BagWriter

WALLS = np.array([6.0, 4.0, 1.25])  # half of the room
SWEEP = 0.1  # s
START = 1_700_000_000.0
BOOT = 1234.5  # on the clock of the sensor at START
AT = np.repeat(np.arange(60), 8) / 60  # when points are measured, as shares of the sweep; the last is 0.983
DROPPED = "points dropped: their times do not fit into the sweep"
UNITS = {"s": 1.0, "ms": 1e3, "µs": 1e6, "ns": 1e9, "shares": 1 / SWEEP}
STAMPED = {"first": 0.0, "middle": SWEEP / 2, "last": SWEEP}
"""When the stamp is, in s after the first point."""


def pose(time: np.ndarray | float) -> np.ndarray:
    """Poses (…, 4, 4) of the robot at times in s after START."""
    time = np.asarray(time, np.float64)
    found = np.tile(np.eye(4), (*time.shape, 1, 1))
    yaw = 0.9 * time
    found[..., 0, 0], found[..., 0, 1] = np.cos(yaw), -np.sin(yaw)
    found[..., 1, 0], found[..., 1, 1] = np.sin(yaw), np.cos(yaw)
    found[..., 0, 3], found[..., 1, 3] = 1.5 * time - 2, 0.8 * time - 1
    return found


def seen(times: np.ndarray, elevations: tuple[float, ...] = (-0.3, -0.1, 0.1, 0.3)) -> np.ndarray:
    """What the sensor measures (N, 3) at times (N,) in s after START, in its own frame."""
    turn = 2 * math.pi * times / SWEEP
    up = np.resize(elevations, len(times))
    rays = np.stack([np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)], 1)
    poses = pose(times)
    ahead, origins = (poses[:, :3, :3] @ rays[:, :, None])[:, :, 0], poses[:, :3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        distances = np.nanmin(np.where(ahead == 0, np.inf, (np.sign(ahead) * WALLS - origins) / ahead), 1)
    return rays * distances[:, None]


def off_the_walls(dataset: Dataset) -> float:
    """The largest distance (m) of a point to the walls."""
    errors = [np.abs(np.abs(scan.points.numpy()) - WALLS[: scan.dim]).min(1).max() for scan in dataset]
    return float(max(errors))


def moving(bag: BagWriter) -> None:
    for tick in range(-15, 75):
        bag.transforms(START + tick / 50, {("odom", "lidar"): pose(tick / 50)})


def record(
    bag: BagWriter,
    unit: str = "s",
    counted: str = "first",
    kind: str = "f8",
    topic: str = "/points",
    field: str = "t",
    begins: Sequence[float] = (0.0, 0.1, 0.2, 0.3),
    at: np.ndarray = AT,
    fault: Callable[[np.ndarray], None] = lambda table: None,
) -> None:
    """Clouds whose times have a unit and a type, and count from the first, middle or last point, are on the
    clock of the stamps (`clock`), or on another one (`boot`). fault: changes the table of each cloud."""
    for begin in begins:
        times, stamp = begin + SWEEP * at, begin + STAMPED.get(counted, 0.0)
        values = (times - {"clock": -START, "boot": -BOOT}.get(counted, stamp)) * UNITS[unit]
        table = np.zeros(len(times), [*((axis, "<f4") for axis in "xyz"), (field, f"<{kind}")])
        table["x"], table["y"], table["z"] = seen(times).T
        table[field] = np.round(values) if kind[0] in "ui" else values
        fault(table)
        bag.cloud_table(topic, int((START + stamp) * 1e9), "lidar", table)


def is_possible(unit: str, counted: str, kind: str) -> bool:
    """Whether a type can hold the times."""
    if unit == "shares" and counted in ("clock", "boot"):
        return False
    if kind[0] in "ui":
        largest = {"clock": START, "boot": BOOT}.get(counted, SWEEP) * UNITS[unit]
        fits = largest < 2 ** (8 * int(kind[1]) - (kind[0] == "i"))
        return unit in ("ms", "µs", "ns") and fits and (kind[0] == "i" or counted not in ("middle", "last"))
    return True


FORMS = [
    (unit, counted, kind)
    for unit in UNITS
    for counted in ("first", "middle", "last", "clock", "boot")
    for kind in ("f4", "f8", "u4", "i4")
    if is_possible(unit, counted, kind)
]


@pytest.fixture(scope="module")
def forms(tmp_path_factory) -> Path:
    """A bag with a topic for each form, and one where a point of each cloud is late."""
    path = tmp_path_factory.mktemp("forms") / "a.mcap"
    with BagWriter(path) as bag:
        moving(bag)
        for unit, counted, kind in FORMS:

            def late(table: np.ndarray, unit: str = unit) -> None:
                table["t"][100] += np.array(3 * SWEEP * UNITS[unit]).astype(table["t"].dtype)

            record(bag, unit, counted, kind, f"/{UNITS[unit]:.0f}/{counted}/{kind}")
            record(bag, unit, counted, kind, f"/{UNITS[unit]:.0f}/{counted}/{kind}/late", fault=late)
    return path


@pytest.mark.parametrize(("unit", "counted", "kind"), FORMS)
def test_points_of_a_moving_robot_lie_on_the_walls(forms, unit, counted, kind):
    for name, n_late in (("", 0), ("/late", 1)):
        dataset = load("rosbag", forms, topic=f"/{UNITS[unit]:.0f}/{counted}/{kind}{name}")
        if (counted, kind) == ("clock", "f4"):
            assert [len(scan.points) for scan in dataset] == [len(AT)] * 4
            reason = "points not deskewed: their times are absolute in float32, which is too coarse"
            assert dataset.skipped == {reason: 4}
            continue
        assert [len(scan.points) for scan in dataset] == [len(AT) - n_late] * 4
        assert off_the_walls(dataset) < (0.01 if unit == "ms" and kind[0] != "f" else 2e-3)
        assert dataset.skipped == ({DROPPED: 4} if n_late else {})


def drive(path: Path, **options: Any) -> Dataset:
    with BagWriter(path) as bag:
        moving(bag)
        record(bag, **options)
    return load("rosbag", path)


NAMES = "t time timestamp time_stamp stamps offset_time timeOffset time_offset_ns point_time_offset"


@pytest.mark.parametrize("field", NAMES.split())
def test_fields_of_public_drivers_are_known(tmp_path, field):
    assert off_the_walls(drive(tmp_path / "a.mcap", field=field)) < 1e-3


def set_time(index: Any, value: float) -> Callable[[np.ndarray], None]:
    def fault(table: np.ndarray) -> None:
        table["t"][index] = value

    return fault


def no_return(table: np.ndarray) -> None:
    """Drivers write zeros, also as times, for beams without return; here a third of all."""
    for name in table.dtype.names:
        table[name][::3] = 0


LAST = len(AT) - 1
FAULTS = {
    "3 s": (set_time(100, 3e9), 1),
    "half a second": (set_time(100, 5e8), 1),
    "two sweeps": (set_time(100, 2e8), 1),
    "120 ms": (set_time(LAST, 1.2e8), 1),
    "120 ms of many": (set_time(slice(-40, None), 1.2e8), 40),
    "the largest number": (set_time(slice(5, 400, 40), 2**32 - 1), 10),
    "too early within the sweep": (set_time(400, 1e7), 2),
    "too late within the sweep": (set_time(100, 9e7), 2),
    "first": (set_time(0, 9e7), 2),
    "last": (set_time(LAST, 1e7), 2),
}


@pytest.mark.parametrize(("fault", "n_wrong"), FAULTS.values(), ids=FAULTS)
def test_points_with_wrong_times_are_dropped_and_counted(tmp_path, fault, n_wrong):
    """A time that breaks the order also drops the point beside it, which could be the wrong one."""
    dataset = drive(tmp_path / "a.mcap", unit="ns", kind="u4", fault=fault)
    assert [len(scan.points) for scan in dataset] == [len(AT) - n_wrong] * 4
    assert off_the_walls(dataset) < 1e-3
    assert dataset.skipped == {DROPPED: 4}


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 0.0, -1e300, 1e300])
def test_times_that_are_no_times_are_dropped(tmp_path, value):
    fault = set_time(slice(3, 400, 40), value)
    dataset = drive(tmp_path / "a.mcap", counted="clock", fault=fault)
    assert [len(scan.points) for scan in dataset] == [len(AT) - 10] * 4
    assert off_the_walls(dataset) < 1e-3
    assert dataset.skipped == {DROPPED: 4}


@pytest.mark.parametrize("counted", ["first", "clock", "boot"])
def test_times_of_beams_without_return_do_not_count(tmp_path, counted):
    dataset = drive(tmp_path / "a.mcap", counted=counted, fault=no_return)
    assert [len(scan.points) for scan in dataset] == [len(AT) * 2 // 3] * 4
    assert (off_the_walls(dataset) < 1e-3, dataset.skipped) == (True, {})


def test_points_in_any_order_keep_theirs(tmp_path):
    """Rows of rings, as organised clouds have them; and a thinned cloud, whose order is random."""
    shuffled = np.random.default_rng(0).permutation(AT)
    for at in (AT.reshape(60, 8).T.ravel(), shuffled):
        dataset = drive(tmp_path / "a.mcap", at=at)
        assert [len(scan.points) for scan in dataset] == [len(AT)] * 4
        assert (off_the_walls(dataset) < 1e-3, dataset.skipped) == (True, {})


def scaled(factor: float) -> Callable[[np.ndarray], None]:
    return lambda table: np.multiply(table["t"], factor, out=table["t"])


def one_of(index: int, fault: Callable[[np.ndarray], None]) -> Callable[[np.ndarray], None]:
    """A fault of one cloud only."""
    clouds = iter(range(100))
    return lambda table: fault(table) if next(clouds) == index else None


@pytest.mark.parametrize(
    ("fault", "reason"),
    [
        (set_time(slice(0, 200), math.nan), "their times are not of one sweep"),
        (set_time(slice(0, 200), 7.0), "their times are not of one sweep"),
        (scaled(0), "their times do not vary"),
        (lambda table: np.add(table["t"], 0.5, out=table["t"]), "their times are far from the stamp"),
        (lambda table: np.add(table["t"], 99, out=table["t"]), "their times are far from the stamp"),
    ],
)
@pytest.mark.parametrize("index", [0, 2])
def test_one_scan_with_unusable_times_is_counted_and_the_others_are_deskewed(tmp_path, index, fault, reason):
    dataset = drive(tmp_path / "a.mcap", fault=one_of(index, fault))
    assert dataset.skipped == {}
    scans = list(dataset)
    assert [len(scan.points) for scan in scans] == [len(AT)] * 4
    assert dataset.skipped == {f"points not deskewed: {reason}": 1}
    assert off_the_walls([scan for i, scan in enumerate(scans) if i != index]) < 1e-3


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"fault": scaled(0)}, "their times do not vary"),
        ({"fault": set_time(slice(None), math.nan)}, "their times are not finite"),
        ({"fault": scaled(1e-5)}, "the unit of their times is not clear"),
        ({"fault": scaled(4)}, "the unit of their times is not clear"),
        ({"unit": "ns", "fault": scaled(2)}, "their times contradict the rate of the scans"),
        (
            {"unit": "shares", "begins": (0.0, 0.5, 1.0)},
            "their times are shares of a sweep, whose duration the rate of the scans does not state",
        ),
        (
            {"unit": "shares", "begins": (0.3,)},
            "their times are shares of a sweep, whose duration the rate of the scans does not state",
        ),
    ],
)
def test_what_is_not_deskewed_is_counted_with_the_reason(tmp_path, options, reason):
    dataset = drive(tmp_path / "a.mcap", **options)
    n_scans = len(options.get("begins", range(4)))
    assert [len(scan.points) for scan in dataset] == [len(AT)] * n_scans
    assert dataset.skipped == {f"points not deskewed: {reason}": n_scans}
    skipped = load("rosbag", tmp_path / "a.mcap", deskew=False).skipped
    assert skipped == {}


def test_stamps_near_zero_are_told_from_times_after_the_stamp(tmp_path):
    """A simulator starts its clock at zero, so that both are small numbers."""
    for is_absolute in (False, True):
        with BagWriter(tmp_path / "a.mcap") as bag:
            for tick in range(75):
                bag.transforms(tick / 50, {("odom", "lidar"): pose(tick / 50)})
            for index in range(5):
                times = index / 10 + SWEEP * AT
                table = np.zeros(len(AT), [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<f8")])
                table["x"], table["y"], table["z"] = seen(times).T
                table["t"] = times - (0 if is_absolute else index / 10)
                bag.cloud_table("/points", index / 10, "lidar", table)
        assert off_the_walls(load("rosbag", tmp_path / "a.mcap")) < 1e-3


# -- one value of one message -------------------------------------------------------------------------

CORRUPTED = st.one_of(
    st.floats(allow_nan=True, allow_infinity=True),
    st.floats(-2, 2).map(lambda share: share * SWEEP * 1e9),
    st.just(0.0),
)


@given(
    kind=st.sampled_from(["f4", "f8", "u4", "u8", "i4"]),
    unit=st.sampled_from(["s", "ms", "µs", "ns"]),
    counted=st.sampled_from(["first", "middle", "last", "clock", "boot"]),
    n_columns=st.integers(30, 200),
    n_rings=st.integers(1, 16),
    is_ordered=st.booleans(),
    seed=st.integers(0, 2**32 - 1),
    value=CORRUPTED,
)
def test_one_wrong_time_never_moves_a_point(kind, unit, counted, n_columns, n_rings, is_ordered, seed, value):
    """A sweep with one wrong time gives all other points, except one beside it, and each at its own time.

    A wrong time that a sweep may have, in points without an order, cannot be told from a right one.
    """
    if not is_possible(unit, counted, kind) or (counted, kind) == ("clock", "f4"):
        return
    rng = np.random.default_rng(seed)
    times = SWEEP * np.repeat(np.arange(n_columns) / n_columns, n_rings)
    times = times if is_ordered else rng.permutation(times)
    found = PointTimes(is_laser=False)
    rate = Rate(SWEEP * 1e9, True, 0.0)
    stamp = STAMPED.get(counted, 0.0)
    zero = {"clock": -START, "boot": -BOOT}.get(counted, stamp)
    right = (times - (0 if counted == "boot" else stamp)) * 1e9
    values = (times - zero) * UNITS[unit]
    values = np.round(values).astype(kind) if kind[0] in "ui" else values.astype(kind)
    wrong, at = values.copy(), int(rng.integers(len(values)))
    with np.errstate(over="ignore", invalid="ignore"):
        wrong[at] = np.array(value * UNITS[unit] / 1e9).astype(kind)
    header = round((START + stamp) * 1e9)
    found.learn(wrong, header, rate)
    offsets, kept = found.offsets(wrong, header)
    assert kept is None or np.count_nonzero(~kept) <= 2
    kept = np.ones(len(wrong), bool) if kept is None else kept
    if counted == "boot":  # the first point counts, and it may be the one that is dropped
        offsets = offsets + round(1e9 * (times[kept].min() if not kept[at] else times.min()))
    error = np.abs(offsets - right[kept]) / (SWEEP * 1e9)
    resolution = 1 / UNITS[unit] / SWEEP if kind[0] in "iu" else 1e-3
    is_right = error < 1e-3 + resolution
    assert is_right[np.flatnonzero(kept) != at].all() or (counted == "boot" and kept[at])
    assert not is_ordered or (error < 0.08 + resolution + 2 / n_columns).all()
