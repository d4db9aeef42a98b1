"""The fused information of views against its twin, which test_view_evaluator compares with slow code."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from kernels.twins import by_both
from numpy.typing import NDArray

from gmmtorch.kernels import kernels
from gmmtorch.team.exploration.planning.collision_checking import LocalMap
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator

FOV = (1.5184, 1.0123)


def evaluator(information: str) -> ViewEvaluator:
    return ViewEvaluator(*FOV, 4.0, 0.2, information, n_beams=60)


def map_of(occupancy: torch.Tensor, observed: torch.Tensor) -> LocalMap:
    free = observed & (occupancy < 0.2)
    return LocalMap(torch.tensor([-12, -12, -6]), 0.2, occupancy.float(), observed, free, free)


def maps() -> dict[str, LocalMap]:
    generator = torch.Generator().manual_seed(0)
    shape = (24, 24, 13)  # not a multiple of the blocks
    random = torch.rand(shape, generator=generator)
    seen = torch.rand(shape, generator=generator) < 0.6
    never, always = torch.zeros(shape, dtype=torch.bool), torch.ones(shape, dtype=torch.bool)
    return {
        "random": map_of(torch.where(seen, random**3, 0.125), seen),
        "unknown": map_of(torch.full(shape, 0.125), never),
        "free": map_of(torch.zeros(shape), always),
        "occupied": map_of(torch.ones(shape), always),
        "nearly free": map_of(torch.full(shape, 1e-7), never),
        "nearly occupied": map_of(torch.full(shape, 1 - 1e-6), never),
        "extremes": map_of((random > 0.9).float(), never),
    }


def views() -> NDArray[np.int64]:
    """Inside, at the border, in the corners, and outside, with every heading."""
    places = [[0, 0, 0], [-6, -6, -3], [5, 5, 3], [-6, 0, 0], [2, -3, 1], [6, 0, 0], [0, 0, -40]]
    return np.array([[*place, yaw] for place in places for yaw in range(16)])


@pytest.mark.parametrize("information", ["csqmi", "fsmi"])
@pytest.mark.parametrize("kind", maps())
def test_fused_information_is_within_its_bound_of_the_twin(information, kind):
    found = by_both(lambda: evaluator(information).evaluate(maps()[kind], views()))
    one, other = found
    largest = one.gain.amax(1, keepdim=True)
    assert ((one.gain - other.gain).abs() <= 1e-4 * largest).all()
    assert (other.gain >= 0).all()
    torch.testing.assert_close(other.gain.sum(1), one.gain.sum(1), rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(other.measured, one.measured, rtol=1e-4, atol=1e-5)


def test_fused_information_does_not_depend_on_the_other_views_or_on_threads():
    some, local_map = views(), maps()["random"]
    with kernels("fused"):
        made = evaluator("csqmi")
        together = made.evaluate(local_map, some).gain
        alone = torch.cat([made.evaluate(local_map, some[i : i + 1]).gain for i in range(0, len(some), 9)])
    assert torch.equal(together[::9], alone)


def test_no_views_have_no_information():
    with kernels("fused"):
        values = evaluator("fsmi").evaluate(maps()["random"], views()[:0])
    assert values.gain.shape == (0, 6 * 6 * 4)
