"""Calibrated maps in a room whose sensor or walls change while it is mapped, and maps of two sensors."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.experiments.evaluation import queries
from gmmtorch.experiments.evaluation.metrics import scores
from gmmtorch.mapping import GaussianMap, TiledMap, merge, tile_files
from gmmtorch.scan import Scan

SIDE = 10.0
BEYOND = 3.0  # m that a sensor sees through the door


def scan(number: int, noise: float, is_open: bool = False) -> Scan:
    """From a circle in a square room. An open door in its upper wall shows a wall behind it."""
    generator = torch.Generator().manual_seed(number)
    turn = 0.3 * number
    origin = 2.5 * torch.tensor([math.cos(turn), math.sin(turn)], dtype=torch.float64)
    angle = torch.rand(180, generator=generator, dtype=torch.float64) * 2 * math.pi
    way = torch.stack([angle.cos(), angle.sin()], 1)
    distance = ((SIDE / 2 * way.sign() - origin) / way).amin(1)
    end = origin + distance[:, None] * way
    if is_open:
        through = (end[:, 1] > SIDE / 2 - 1e-6) & (end[:, 0].abs() < 1.0)
        distance = torch.where(through, (SIDE / 2 + BEYOND - origin[1]) / way[:, 1], distance)
    distance = distance + noise * torch.randn(180, generator=generator, dtype=torch.float64)
    return Scan(origin + distance[:, None] * way, origin)


def built(scans: list[Scan], **options: int) -> GaussianMap:
    made = GaussianMap(window=3, **options)
    for one in scans:
        made.insert(one)
    made.finish()
    return made


def asked(scans: list[Scan], side: float) -> tuple[Tensor, Tensor]:
    """Test points of unseen scans, and whether they are occupied."""
    found = queries.hit_and_free(*queries.test_beams(scans, 20_000, 0), "uniform", side, 0)
    return found.points, found.labels == queries.OCCUPIED


def unseen(noise: float, is_open: bool = False) -> list[Scan]:
    return [scan(number, noise, is_open) for number in range(1000, 1040)]


@pytest.mark.parametrize(("before", "after"), [(0.01, 0.1), (0.1, 0.01)])
@pytest.mark.parametrize("side", [0.05, 0.2])
def test_a_sensor_whose_noise_changes(before, after, side):
    made = built([scan(n, before if n < 60 else after) for n in range(120)])
    points, occupied = asked([*unseen(before), *unseen(after)], side)
    theta = torch.as_tensor(made.occupancy(points, side))
    found = scores(theta, occupied.long())
    assert found["ece"] < 0.05
    assert found["accuracy"] > 0.93


def test_a_door_that_opens():
    made = built([scan(n, 0.02, is_open=n >= 60) for n in range(120)])
    points, occupied = asked(unseen(0.02, is_open=True), 0.1)
    theta = torch.as_tensor(made.occupancy(points, 0.1))
    assert scores(theta, occupied.long())["ece"] < 0.05
    door = torch.tensor([[0.0, SIDE / 2]], dtype=torch.float64)
    closed = built([scan(n, 0.02) for n in range(120)])
    assert float(made.occupancy(door, 0.1)) < float(closed.occupancy(door, 0.1))
    assert float(made.occupancy(door + torch.tensor([0.0, BEYOND]), 0.1)) > 0.5


def test_a_map_of_two_sensors(tmp_path):
    parts = [
        built([scan(n, noise) for n in range(60 * k, 60 * k + 60)], robot=k)
        for k, noise in enumerate((0.01, 0.1))
    ]
    merged = []
    for order in ((0, 1), (1, 0)):
        folders = [tmp_path / f"{order}{k}" for k in order]
        for k, folder in zip(order, folders, strict=True):
            folder.mkdir()
            for name, data in tile_files(parts[k].components(), parts[k].settings, 20.0).items():
                (folder / name).write_bytes(data)
        merged.append(merge(tmp_path / f"both{order}", [TiledMap(folder) for folder in folders]))
    for noise in (0.01, 0.1):
        points, occupied = asked(unseen(noise), 0.1)
        theta = [torch.as_tensor(one.occupancy(points, 0.1)) for one in merged]
        assert torch.equal(*theta)
        found = scores(theta[0], occupied.long())
        assert found["ece"] < 0.06
        assert found["accuracy"] > 0.93


@pytest.mark.parametrize("side", [1e-4, 1e-3, 0.01])
def test_a_question_finer_than_the_noise(side):
    made = built([scan(n, 0.1) for n in range(60)])
    points, occupied = asked(unseen(0.1), side)
    theta = torch.as_tensor(made.occupancy(points, side))
    assert bool(((theta >= 0) & (theta <= 1)).all())
    assert scores(theta, occupied.long())["ece"] < 0.06
