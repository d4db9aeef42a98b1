"""MixtureTiles against a search through all batches; refilled windows against new ones."""

from __future__ import annotations

import pytest
import torch
from mapping.random_components import random_components

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.voxels.cells import Box
from gmmtorch.occupancy.voxels.rolling_window import RollingWindow
from gmmtorch.team.exploration.robot.component_rays import MixtureTiles, component_evidence, regenerate

RESOLUTION, SHAPE = 0.25, (24, 20, 12)


def batch(seed: int, center: float = 0.0, extent: float = 6.0, deviations=(5e-3, 0.6)) -> Components:
    return random_components(
        3, k=12, seed=seed, center=center, extent=extent, deviations=deviations, n_origins=3, robot=seed
    )


def many(n: int = 30, tile: float = 4.0) -> tuple[MixtureTiles, list[Components]]:
    """Batches along a diagonal of the world; batch 7 covers everything, the last one is empty."""
    batches = [
        batch(seed, center=3.0 * seed - 40, deviations=(50.0, 200.0) if seed == 7 else (5e-3, 0.6))
        for seed in range(n)
    ]
    tiles, batches = MixtureTiles(tile), [*batches, Components.empty(3)]
    for each in batches:
        tiles.add(each)
    return tiles, batches


@pytest.mark.parametrize(("seed", "tile"), [*((seed, 4.0) for seed in range(6)), (6, 1.0), (7, 1000.0)])
def test_near_lists_every_batch_with_evidence_in_the_box(seed, tile):
    tiles, batches = many(tile=tile)
    generator = torch.Generator().manual_seed(seed)
    middle = torch.full((3,), 12 * seed - 160) + torch.randint(-9, 9, (3,), generator=generator)
    box = Box(middle, middle + torch.randint(1, 30, (3,), generator=generator))
    rows = [id(each) for each in batches]
    found = [rows.index(id(each)) for each in tiles.near(box, RESOLUTION)]
    assert found == sorted(set(found))  # in insertion order, each once
    telling = [n for n, each in enumerate(batches) if len(component_evidence(each, RESOLUTION, box).cells)]
    assert {7, *telling} <= set(found)
    assert 30 not in found


def test_near_omits_distant_batches():
    tiles, batches = many()
    low = torch.tensor([-160] * 3)
    assert 1 <= len(tiles.near(Box(low, low + 8), RESOLUTION)) < 8
    far = torch.tensor([10**6] * 3)
    assert tiles.near(Box(far, far + 5), RESOLUTION) == []
    everything = Box(torch.tensor([-(10**7)] * 3), torch.tensor([10**7] * 3))
    assert len(tiles.near(everything, RESOLUTION)) == len(batches) - 1  # all but the empty one


def scratch(sliding: RollingWindow, batches: list[Components]) -> RollingWindow:
    """A new window at the same place with the evidence of all batches."""
    made = RollingWindow(RESOLUTION, SHAPE, sliding.step)
    made.center_on((sliding.box.low + torch.tensor(SHAPE) // 2 + 0.5).double() * RESOLUTION)
    assert torch.equal(made.box.low, sliding.box.low)
    if batches:
        whole = Components.concatenate(batches)
        made.add(component_evidence(whole, RESOLUTION, Box(made.box.low - 400, made.box.low + 400)))
    return made


@pytest.mark.parametrize("seed", range(2))
def test_a_regenerated_window_equals_a_new_window(seed):
    generator = torch.Generator().manual_seed(seed)
    sliding, tiles = RollingWindow(RESOLUTION, SHAPE, 4), MixtureTiles(4.0)
    robot, batches = torch.zeros(3, dtype=torch.float64), []
    for number in range(12):
        robot = robot + torch.randn(3, generator=generator, dtype=torch.float64) * (
            8.0 if number == 6 else 1.2
        )
        regenerate(sliding, sliding.center_on(robot), tiles, component_evidence)
        learned = batch(100 * seed + number, center=float(robot.mean()), extent=5.0)
        tiles.add(learned)
        batches.append(learned)
        sliding.add(component_evidence(learned, RESOLUTION, sliding.box))
        expected = scratch(sliding, batches)
        for one, other in zip(sliding.evidence(), expected.evidence(), strict=True):
            torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)
            assert torch.equal(one == 0, other == 0)  # unseen is exactly unseen


def test_invalid_arguments_are_refused():
    with pytest.raises(InvalidArgumentError, match="tile=0"):
        MixtureTiles(0)
    tiles = MixtureTiles()
    with pytest.raises(InvalidArgumentError, match="2 dimensions"):
        tiles.add(random_components(2))
    broken = batch(2)
    broken.means[0, 0] = float("nan")
    with pytest.raises(InvalidArgumentError, match="NaN"):
        tiles.add(broken)
