"""Views against slow code that steps along each beam, and what their values must obey on any map."""

from __future__ import annotations

import gc
import math
import weakref

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.team.exploration.planning.collision_checking import LocalMap
from gmmtorch.team.exploration.planning.view_evaluator import ViewEvaluator, ViewValues

FOV = (1.5184, 1.0123)
RESOLUTION = 0.2


def local_map(occupancy, observed, low=(0, 0, 0), resolution=RESOLUTION):
    free = observed & (occupancy < 0.2)
    return LocalMap(torch.tensor(low), resolution, occupancy.float(), observed, free, free)


def random_map(shape, seed, low=(0, 0, 0)):
    """Cells of every kind: never observed, known free and occupied, and in between."""
    generator = torch.Generator().manual_seed(seed)
    kind = torch.rand(shape, generator=generator)
    between = torch.rand(shape, generator=generator)
    occupancy = torch.full(shape, 0.125)
    occupancy[kind > 0.3] = 0.02
    occupancy[kind > 0.9] = 0.97
    occupancy = torch.where(kind > 0.93, between, occupancy)
    return local_map(occupancy, kind > 0.3, low)


def hall(shape=(80, 80, 32), known=14, low=(-40, -40, -16), prior=0.125):
    """A round known part in the middle of the unknown, with a wall across it that has a door."""
    x, y, z = torch.meshgrid(*(torch.arange(n) - n // 2 for n in shape), indexing="ij")
    observed = (x**2 + y**2 < known**2) & (z.abs() < 10)
    occupancy = torch.full(shape, prior)
    occupancy[observed] = 0.02
    occupancy[observed & (y == 6) & ((x - 2).abs() > 2)] = 0.9
    return local_map(occupancy, observed, low)


def unknown(shape=(72, 72, 36), low=(-36, -36, -18), prior=0.125):
    return local_map(torch.full(shape, prior), torch.zeros(shape, dtype=torch.bool), low)


def all_headings(evaluator, cell=(0, 0, 0)):
    keys = np.array([[*cell, yaw] for yaw in range(evaluator.n_yaws)])
    keys[:, :3] //= evaluator.stride
    return keys


def given_views(values: ViewValues, first: int, second: int) -> float:
    """Share of the second view's value that the first one leaves."""
    left = values.gain[second].double() @ (1 - values.measured[first].double())
    return float(left / values.gain[second].sum())


# --- the same by slow code ----------------------------------------------------------------------


def slow_beams(n_columns, n_rows, n_inner=40):
    """Directions by angles, solid angles by summing over the image: du dv / (1 + u² + v²)^(3/2)."""
    beams = []
    for row in range(n_rows):
        for column in range(n_columns):
            angle = [
                [(i + j) / n * fov - fov / 2 for j in (0.0, 0.5, 1.0)]
                for i, n, fov in ((column, n_columns, FOV[0]), (row, n_rows, FOV[1]))
            ]
            (u0, u, u1), (v0, v, v1) = ([math.tan(a) for a in angles] for angles in angle)
            inner = [
                1 / (1 + a * a + b * b) ** 1.5
                for a in (u0 + (u1 - u0) * (i + 0.5) / n_inner for i in range(n_inner))
                for b in (v0 + (v1 - v0) * (i + 0.5) / n_inner for i in range(n_inner))
            ]
            beams.append(((1.0, u, v), sum(inner) / n_inner**2 * (u1 - u0) * (v1 - v0)))
    return beams


def stepped(direction, reach):
    """(cell, way in, way out) along a ray from the centre of cell 0, in cells, one plane at a time."""
    cell, t, out = [0, 0, 0], 0.0, []
    while True:
        planes = []
        for axis in range(3):
            d = direction[axis]
            plane = (cell[axis] + (0.5 if d > 0 else -0.5)) / d if abs(d) > 1e-12 else math.inf
            planes.append(plane)
        after = min(planes)
        out.append((tuple(cell), t, min(after, reach)))
        if after >= reach:
            return out
        axis = planes.index(after)
        cell[axis] += 1 if direction[axis] > 0 else -1
        t = after


def information_by_definition(occupancies, depths, information, sigma):
    """Of one beam, by the sums that define it."""
    reach, hit = 1.0, []
    for o in occupancies:
        hit.append(reach * o)
        reach *= 1 - o
    if information == "fsmi":
        # The odds change by 100: what every outcome tells about every cell.
        def told(o, delta):
            after = o * delta / (o * delta + (1 - o))
            return sum(a * math.log(a / b) for a, b in ((after, o), (1 - after, 1 - o)) if a > 0)

        total = 0.0
        for event, p in enumerate([*hit, reach]):
            passed = sum(told(o, 0.01) for o in occupancies[:event]) if p > 0 else 0.0
            ended = told(occupancies[event], 100.0) if event < len(occupancies) and p > 0 else 0.0
            total += p * (passed + ended)
        return total
    reach, sharp = 1.0, []
    for o in occupancies:
        q = o * o / (o * o + (1 - o) ** 2)
        sharp.append(reach * q)
        reach *= 1 - q
    p = torch.tensor([*hit, 1 - sum(hit)], dtype=torch.float64)
    v = torch.tensor([*sharp, 1 - sum(sharp)], dtype=torch.float64)
    d = torch.tensor([*depths, 1e6], dtype=torch.float64)
    kernel = torch.exp(-((d[:, None] - d) ** 2) / (4 * sigma**2))
    return float(torch.log(p @ kernel @ p) - 2 * torch.log(p @ kernel @ v))


def view_by_loops(around, camera, yaw, max_range, beams, information):
    """Gain and measured (G,) of one view from a cell of the window, in plain loops."""
    shape = around.shape
    blocks = [-(-n // 4) for n in shape]
    n_blocks = math.prod(blocks)

    def occupancy(cell):
        o, seen = float(around.occupancy[cell]), bool(around.observed[cell])
        if seen and o <= 0.05:
            return 0.0
        return 1.0 if seen and o >= 0.5 else o

    def block(cell):
        return (cell[0] // 4 * blocks[1] + cell[1] // 4) * blocks[2] + cell[2] // 4

    gain, taken, there = [0.0] * n_blocks, [0.0] * n_blocks, [0.0] * n_blocks
    for cell in torch.ones(shape).nonzero().tolist():
        o = occupancy(tuple(cell))
        there[block(cell)] += o * (1 - o)
    for (x, y, z), solid_angle in beams:
        norm = math.sqrt(x * x + y * y + z * z)
        turned = (
            (math.cos(yaw) * x - math.sin(yaw) * y) / norm,
            (math.sin(yaw) * x + math.cos(yaw) * y) / norm,
            z / norm,
        )
        met = []
        for offset, enter, leave in stepped(turned, max_range / RESOLUTION):
            cell = tuple(c + o for c, o in zip(camera, offset, strict=True))
            if not all(0 <= c < n for c, n in zip(cell, shape, strict=True)):
                break
            met.append((cell, occupancy(cell), enter, leave))
        occupancies = [o for _, o, _, _ in met]
        depths = [(enter + leave) / 2 * RESOLUTION for _, _, enter, leave in met]
        told = information_by_definition(occupancies, depths, information, 0.05) if met else 0.0
        reach, resolved = 1.0, []
        for o in occupancies:
            resolved.append(reach * o * (1 - o))
            reach *= 1 - o
        if sum(resolved) < 1e-4:
            continue
        for (cell, o, enter, leave), r in zip(met, resolved, strict=True):
            volume = solid_angle * (leave**3 - enter**3) / 3
            gain[block(cell)] += told * r / sum(resolved) * volume
            taken[block(cell)] += min(r / 0.05, o * (1 - o)) * volume
    measured = [min(t / (0.25 * u), 1.0) if u > 0 else 0.0 for t, u in zip(taken, there, strict=True)]
    return torch.tensor(gain), torch.tensor(measured)


@pytest.mark.parametrize("information", ["csqmi", "fsmi"])
@pytest.mark.parametrize("seed", range(3))
def test_view_values_equal_a_slow_reference(information, seed):
    """On maps of any kind, from everywhere, at the window's border and outside; no side divides by 4."""
    shape, low = (17, 14, 11), (-5, 3, -4)
    around = random_map(shape, seed, low)
    evaluator = ViewEvaluator(*FOV, 2.3, RESOLUTION, information, n_beams=24, n_yaws=8, stride=2)
    assert evaluator.n_beams == 24
    generator = torch.Generator().manual_seed(seed)
    cells = torch.stack([torch.randint(-3, n + 3, (12,), generator=generator) for n in shape], 1)
    keys = torch.cat(
        [
            (cells + torch.tensor(low)).div(2, rounding_mode="floor"),
            torch.randint(0, 8, (12, 1), generator=generator),
        ],
        1,
    ).numpy()
    keys[0, :3] = (0, 4, 0)  # one at least well inside
    got = evaluator.evaluate(around, keys)
    beams = slow_beams(6, 4)
    n_seeing = 0
    for row, key in enumerate(keys.tolist()):
        camera = tuple(2 * k - c for k, c in zip(key[:3], low, strict=True))
        if all(0 <= c < n for c, n in zip(camera, shape, strict=True)):
            gain, measured = view_by_loops(around, camera, key[3] * math.pi / 4, 2.3, beams, information)
            n_seeing += 1
        else:
            gain = measured = torch.zeros(got.gain.shape[1])
        torch.testing.assert_close(got.gain[row], gain.float(), rtol=2e-3, atol=2e-4)
        torch.testing.assert_close(got.measured[row], measured.float(), rtol=2e-3, atol=2e-4)
    assert n_seeing >= 3


# --- what values obey ---------------------------------------------------------------------------


@pytest.fixture(scope="module", params=["csqmi", "fsmi"])
def evaluator(request):
    return ViewEvaluator(*FOV, 6.0, RESOLUTION, request.param)


@pytest.mark.parametrize("make", [hall, unknown])
def test_repeated_view_is_worth_little(evaluator, make):
    around = make()
    keys = np.concatenate([all_headings(evaluator, (x, y, 0)) for x in (-6, 0, 6) for y in (-4, 0, 4)])
    values = evaluator.evaluate(around, keys)
    worths = values.gain.sum(1)
    worth = (worths > 0.2 * worths.max()).nonzero()[:, 0].tolist()
    left = [given_views(values, i, i) for i in worth]
    assert len(left) > 50
    assert max(left) <= 0.15


def test_residual_is_the_product_over_all_views(evaluator):
    around = hall()
    keys = all_headings(evaluator)[:5]
    values = evaluator.evaluate(around, keys)
    expected = torch.ones(values.gain.shape[1])
    for row in values.measured:
        expected *= 1 - row
    poses = evaluator.poses(keys)
    torch.testing.assert_close(evaluator.residual(around, poses), expected)
    outside = poses + torch.tensor([100.0, 0, 0, 0])
    assert torch.equal(evaluator.residual(around, outside), torch.ones_like(expected))
    torch.testing.assert_close(evaluator.residual(around, torch.cat([outside, poses])), expected)
    assert torch.equal(evaluator.residual(around, poses[:0].float()), torch.ones_like(expected))


def test_local_maps_are_cached_by_identity_and_released():
    evaluator = ViewEvaluator(*FOV, 2.0, RESOLUTION, n_beams=30, n_yaws=4)
    keys = np.array([[3, 3, 2, 0]])
    maps = [random_map((15, 14, 9), 0), random_map((15, 14, 9), 1), random_map((14, 15, 10), 1)]
    fresh = [ViewEvaluator(*FOV, 2.0, RESOLUTION, n_beams=30, n_yaws=4).evaluate(m, keys).gain for m in maps]
    for index in (0, 1, 2, 1, 0):
        assert torch.equal(evaluator.evaluate(maps[index], keys).gain, fresh[index])
    gone = weakref.ref(maps.pop())
    gc.collect()
    assert gone() is None


# --- the lattice of poses -----------------------------------------------------------------------

coordinates = st.floats(-6e5, 6e5)


@given(st.tuples(coordinates, coordinates, coordinates, st.floats(-50, 50)))
def test_keys_are_the_nearest_lattice_poses(pose):
    evaluator = ViewEvaluator(*FOV, 1.0, RESOLUTION, n_beams=4)
    keys = evaluator.keys(torch.tensor([pose], dtype=torch.float64))
    nearest = evaluator.poses(keys)
    assert (evaluator.keys(nearest) == keys).all()
    assert nearest.dtype == torch.float64
    x, y, z, yaw = nearest[0].tolist()
    for got, wanted in zip((x, y, z), pose, strict=False):
        assert abs(got - wanted) <= RESOLUTION + 1e-6
    apart = math.remainder(yaw - pose[3], 2 * math.pi)
    assert abs(apart) <= math.pi / 16 + 1e-9


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_lattice_positions_are_centres_of_every_nth_cell(stride):
    evaluator = ViewEvaluator(*FOV, 1.0, RESOLUTION, n_beams=4, stride=stride, n_yaws=6)
    keys = np.array([[-3, 0, 7, 5]])
    x, y, z, yaw = evaluator.poses(keys)[0].tolist()
    assert [x, y, z] == pytest.approx([(k * stride + 0.5) * RESOLUTION for k in (-3, 0, 7)])
    assert yaw == pytest.approx(5 * 2 * math.pi / 6)


def test_rejects_bad_input():
    evaluator = ViewEvaluator(*FOV, 1.0, RESOLUTION, n_beams=4)
    around = random_map((9, 9, 9), 0)
    for bad in (math.nan, math.inf, 1e300):
        for column in range(4):
            poses = torch.zeros(1, 4, dtype=torch.float64)
            poses[0, column] = bad
            with pytest.raises(InvalidArgumentError, match="poses"):
                evaluator.keys(poses)
    with pytest.raises(InvalidArgumentError, match="poses"):
        evaluator.residual(around, torch.zeros(3))
    key = np.zeros((1, 4), np.int64)
    coarse = local_map(torch.full((4, 4, 4), 0.1), torch.zeros(4, 4, 4, dtype=torch.bool), (0, 0, 0), 0.3)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        evaluator.evaluate(coarse, key)
    for options, match in (
        ({"information": "entropy"}, "csqmi, fsmi"),
        ({"n_beams": 0}, "n_beams"),
        ({"n_yaws": 0}, "n_yaws"),
        ({"stride": 0}, "stride"),
    ):
        with pytest.raises(InvalidArgumentError, match=match):
            ViewEvaluator(*FOV, 6.0, RESOLUTION, **options)
    with pytest.raises(InvalidArgumentError, match="resolution"):
        ViewEvaluator(*FOV, 6.0, 0.0)
