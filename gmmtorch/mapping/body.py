"""A robot's body as a set of balls: its clearance and its probability of collision along a path."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.clearance import clearance, expected_returns
from gmmtorch.mapping.surfaces import Surfaces


@dataclass(frozen=True)
class Body:
    """B balls that cover a robot, in its own frame.

    centres (B, D): metres. D is 2 or 3.
    radii (B,): metres, above zero.

    Raises `InvalidArgumentError` for other shapes or values, or no ball.
    """

    centres: Tensor
    radii: Tensor

    def __init__(self, centres: ArrayLike, radii: ArrayLike) -> None:
        places = as_tensor(centres, "centres", torch.float64)
        sizes = as_tensor(radii, "radii", torch.float64)
        if places.ndim != 2 or places.shape[1] not in (2, 3) or not len(places):
            raise InvalidArgumentError(f"centres has shape {tuple(places.shape)}; expected (B, 2) or (B, 3).")
        if sizes.shape != places.shape[:1]:
            raise InvalidArgumentError(f"radii has shape {tuple(sizes.shape)}; expected ({len(places)},).")
        if not bool(torch.isfinite(places).all() & torch.isfinite(sizes).all() & (sizes > 0).all()):
            raise InvalidArgumentError("centres and radii must be finite, and radii above zero.")
        object.__setattr__(self, "centres", places)
        object.__setattr__(self, "radii", sizes)

    def clearance(
        self, surfaces: Surfaces, poses: ArrayLike, deviations: float = 2.0, least_density: float = 0.0
    ) -> Tensor:
        """Distance (S,), metres, from the body at each pose to the nearest surface; negative in collision.

        Args:
            surfaces: a map, its components, or (means, covariances, weights).
            poses: (S, D+1, D+1), map ← body.
            deviations, least_density: which ellipsoids are obstacles, as in `clearance`.

        Differentiable in the poses: the gradient moves a path away from surfaces.
        """
        balls = self._placed(poses)
        gaps = clearance(surfaces, balls.flatten(0, 1), deviations, least_density).unflatten(
            0, balls.shape[:2]
        )
        return (gaps - self.radii.to(gaps)).amin(1)

    def collision_probability(self, surfaces: Surfaces, poses: ArrayLike) -> Tensor:
        """Probability (S,) that the body at each pose touches a return of the map.

            P = 1 − exp(−Σ_b n_b),   n_b the expected number of returns in ball b

        A return in several balls counts several times, so P is an upper bound if balls overlap.
        `poses`: (S, D+1, D+1), map ← body.
        """
        balls = self._placed(poses).detach()
        expected = torch.zeros(len(balls), dtype=torch.float64, device=balls.device)
        for radius in self.radii.unique().tolist():  # balls of one size are queried together
            places = balls[:, (self.radii == radius).to(balls.device)]
            returns = expected_returns(surfaces, places.flatten(0, 1), radius)
            expected = expected + returns.unflatten(0, places.shape[:2]).sum(1)
        return -torch.expm1(-expected)

    def _placed(self, poses: ArrayLike) -> Tensor:
        """Centres (S, B, D) of the balls at the poses."""
        dim = self.centres.shape[1]
        matrices = as_tensor(poses, "poses", torch.float64)
        if matrices.ndim != 3 or matrices.shape[1:] != (dim + 1, dim + 1):
            raise InvalidArgumentError(
                f"poses has shape {tuple(matrices.shape)}; expected (S, {dim + 1}, {dim + 1})."
            )
        centres = self.centres.to(matrices.device)
        return centres @ matrices[:, :dim, :dim].mT + matrices[:, None, :dim, dim]
