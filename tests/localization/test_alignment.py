"""The alignment of points with surfaces, against sums over all pairs and automatic differentiation."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from gmmtorch.localization import alignment
from gmmtorch.localization.alignment import AlignmentTarget, align, everywhere, main_normals
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.pose import Pose, generators


def wall_and_corner(dim: int) -> Parameters:
    """Flat components on the sides of a room of 6 m."""
    generator = torch.Generator().manual_seed(0)
    means, covariances = [], []
    for axis in range(dim):
        for side in (-3.0, 3.0):
            mean = 6 * torch.rand(12, dim, generator=generator).double() - 3
            mean[:, axis] = side
            variance = torch.full((dim,), 0.2).double()
            variance[axis] = 1e-4
            means.append(mean)
            covariances.append(torch.diag(variance).repeat(12, 1, 1))
    weights = torch.ones(24 * dim).double()
    return Parameters(weights, torch.cat(means), torch.cat(covariances))


def points_on(surfaces: Parameters, n: int) -> Tensor:
    generator = torch.Generator().manual_seed(1)
    which = torch.randint(len(surfaces.weights), (n,), generator=generator)
    roots = torch.linalg.cholesky(surfaces.covariances[which])
    noise = torch.randn(n, surfaces.means.shape[1], 1, generator=generator, dtype=torch.float64)
    return surfaces.means[which] + (roots @ noise)[:, :, 0]


def score_of_all_pairs(points: Tensor, surfaces: Parameters, blur: float, step: Tensor) -> Tensor:
    """ℓ after a small step (F,) from the identity, over all pairs within the cutoff."""
    dim = points.shape[1]
    turn = torch.linalg.matrix_exp(torch.einsum("k,kij->ij", step[dim:], generators(dim).to(step)))
    offset = (points @ turn.T + step[:dim])[:, None] - surfaces.means
    precision = torch.linalg.inv(surfaces.covariances + blur**2 * torch.eye(dim))
    square = torch.einsum("nki,kij,nkj->nk", offset, precision, offset)
    heights = torch.where(square <= alignment.CUTOFF**2, torch.exp(-0.5 * square), 0.0)
    return torch.log1p(heights.sum(1) / alignment._OUTLIERS).sum()


@pytest.mark.parametrize("dim", [2, 3])
def test_score_gradient_and_curvature_of_shifts_equal_those_of_all_pairs(dim):
    surfaces, blur = wall_and_corner(dim), 0.2
    points = points_on(surfaces, 40) + 0.05
    sums = AlignmentTarget(surfaces, blur).sums(points, Pose.identity(dim, 1))
    none = torch.zeros(dim + dim * (dim - 1) // 2).double()

    def score(step: Tensor) -> Tensor:
        return score_of_all_pairs(points, surfaces, blur, step)

    torch.testing.assert_close(sums.score[0], score(none))
    torch.testing.assert_close(sums.gradient[0], torch.autograd.functional.jacobian(score, none))
    hessian = torch.autograd.functional.hessian(score, none)
    torch.testing.assert_close(sums.observed[0, :dim, :dim], -hessian[:dim, :dim])


@pytest.mark.parametrize("dim", [2, 3])
def test_align_finds_the_pose_of_points_on_the_surfaces(dim):
    surfaces = wall_and_corner(dim)
    points = points_on(surfaces, 500)
    step = (
        torch.tensor([[0.2, -0.15, 0.05, 0.06]]).double() if dim == 2 else torch.full((1, 6), 0.08).double()
    )
    motions = Pose.identity(dim, 1).moved(step[:, : dim + dim * (dim - 1) // 2])
    for blur in (0.25, 0.1, 0.03):
        found = align(points, AlignmentTarget(surfaces, blur), motions, 15)
        motions = found.motions
    assert float(motions.translation.norm()) < 0.02
    assert float((motions.rotation[0] - torch.eye(dim)).abs().max()) < 0.01
    assert float(found.explained[0]) > 0.95
    assert bool(found.converged[0])


def test_a_single_wall_does_not_fix_the_shift_along_it():
    n = 40
    means = torch.stack([torch.linspace(-10, 10, n), torch.zeros(n)], 1).double()
    wall = Parameters(
        torch.ones(n).double(), means, torch.diag(torch.tensor([0.3, 1e-4]).double()).repeat(n, 1, 1)
    )
    points = torch.stack([torch.linspace(-5, 5, 400), torch.zeros(400)], 1).double()
    sums = AlignmentTarget(wall, 0.03).sums(points, Pose.identity(2, 1))
    assert float(sums.complete[0, 0, 0]) > 100  # each component alone would fix it
    assert abs(float(sums.observed[0, 0, 0])) < 0.02 * float(sums.complete[0, 0, 0])


def test_a_surface_seen_from_behind_explains_no_point():
    surfaces = wall_and_corner(2)
    points = points_on(surfaces, 50)
    toward_the_room = -surfaces.means.sign() * (surfaces.means.abs() > 2.99)
    inside = AlignmentTarget(surfaces, 0.1, toward_the_room).sums(points, Pose.identity(2, 1))
    outside = AlignmentTarget(surfaces, 0.1, -toward_the_room).sums(points, Pose.identity(2, 1))
    assert float(inside.n_explained[0]) > 45
    assert float(outside.n_explained[0]) == 0


def test_main_normals_are_those_of_most_flat_area_and_apart():
    """A floor in two parts, a wall, a smaller wall at 20° to it, and a thick blob that does not count."""
    frame = Pose.from_turn(torch.tensor([0.3, -0.2, 0.5]).double()).rotation
    turned = Pose.from_turn(torch.tensor([0, 0, math.radians(20)]).double()).rotation
    floor, wall, blob = (torch.tensor(v).double() for v in ([4, 4, 1e-4], [1e-4, 3, 1], [9, 9, 2.0]))
    bases = [torch.eye(3).double()] * 3 + [turned, torch.eye(3).double()]
    shapes = [
        basis @ v.diag() @ basis.T
        for basis, v in zip(bases, [floor, floor, wall, wall / 2, blob], strict=True)
    ]
    covariances = frame @ torch.stack(shapes) @ frame.T
    found = main_normals(Parameters(torch.ones(5) / 5, torch.zeros(5, 3).double(), covariances))
    assert (found @ frame).abs().round(decimals=9).tolist() == [[0, 0, 1], [1, 0, 0]]
    only_blob = Parameters(torch.ones(1), torch.zeros(1, 3).double(), covariances[4:])
    assert main_normals(only_blob).shape == (0, 3)


def test_everywhere_turns_each_axis_to_its_target_with_all_headings():
    generator = torch.Generator().manual_seed(0)
    places = torch.randn(3, 3, generator=generator).double()
    axes, targets = torch.nn.functional.normalize(torch.randn(2, 4, 3, generator=generator).double(), dim=2)
    starts = everywhere(places, 1.0, axes, targets)
    n = len(starts) // 12
    rotations = starts.rotation.view(3, 4, n, 3, 3)
    assert torch.allclose(rotations @ axes[:, None, :, None], targets[:, None, :, None].expand(3, 4, n, 3, 1))
    assert torch.allclose(rotations.det(), torch.ones(()).double())
    step = Pose(rotations[0, :, 1] @ rotations[0, :, 0].mT, torch.zeros(4, 3).double())
    assert torch.allclose(step.angle(), torch.tensor(2 * math.pi / n).double())
    assert torch.equal(starts.translation.view(3, -1, 3), places[:, None].expand(3, 4 * n, 3))
