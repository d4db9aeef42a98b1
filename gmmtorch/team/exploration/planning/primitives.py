"""Motion primitives of a quadrotor: short flights at commanded velocities, and the braking after them.

A state (7,) is x, y, z, yaw, and the velocities v (along the heading), v_z (up) and ω (yaw rate); world
frame, metres, radians, seconds. Yaw is not wrapped, so it has no jumps.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import Library
from gmmtorch.team.exploration.mission.options import Dynamics

_QUADRATURE = ((0.5 - math.sqrt(0.15), 5 / 18), (0.5, 8 / 18), (0.5 + math.sqrt(0.15), 5 / 18))
"""Gauss–Legendre nodes and weights on [0, 1]."""
_ROUNDING = 1e-9


class Primitives:
    """The set of primitives: arcs, climbing arcs, slow arcs, turns in place, vertical motion, and a stop.

    commands: (P, 3) float64, the final velocities v, v_z, ω of each primitive. stop: index of the
    primitive that comes to rest. library: the paths after each primitive. longest: (P, 2), the longest step
    (m) and the largest turn (rad) in a step of these.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        self.dynamics = dynamics
        v, c, w = dynamics.speed, dynamics.climb, dynamics.yaw_rate
        arcs = [(v, up, turn) for up in (0.0, c, -c) for turn in (0.0, w / 2, -w / 2, w, -w)]
        slow = [(v / 2, 0.0, turn) for turn in (0.0, w, -w)]
        turns = [(0.0, 0.0, turn) for turn in (w, -w, w / 2, -w / 2)]
        vertical = [(0.0, c, 0.0), (0.0, -c, 0.0)]
        library = [*arcs, *slow, *turns, *vertical, (0.0, 0.0, 0.0)]
        self.commands = torch.tensor(library, dtype=torch.float64)
        self.stop = len(library) - 1
        # Nearly all queried states are ends of primitives, so their continuations are computed once.
        ends = torch.cat([torch.zeros(len(library), 4, dtype=torch.float64), self.commands], 1)
        self._paths = self._rollout(ends)
        self._stops = self._braking(ends)
        self.library = Library(len(library), dynamics.n_steps, self._stops.shape[1], self._paths, self._stops)
        self.longest = self._longest_steps()

    def __len__(self) -> int:
        return len(self.commands)

    @property
    def reach(self) -> float:
        """Largest distance (m) that a robot covers from rest by one primitive, until it is at rest again."""
        paths = self._rollout(torch.zeros(1, 7, dtype=torch.float64))[0]
        return float(self.braking(paths[:, -1])[..., :3].norm(dim=-1).max())

    def rollout(self, states: Tensor) -> Tensor:
        """Return states (N, P, S, 7) after 1, 2, …, S steps of every primitive from states (N, 7).

        Velocities are linear within a step h:

            z += h (v_z⁰ + v_z¹)/2,   ψ += h (ω⁰ + ω¹)/2,   (x, y) += ∫₀ʰ v(t) (cos ψ(t), sin ψ(t)) dt

        The integral uses three Gauss–Legendre nodes. At constant velocities it equals the closed form
        x += v/ω (sin(ψ + ωT) − sin ψ), y += v/ω (cos ψ − cos(ψ + ωT)) to better than 10⁻⁸ m.
        """
        states = states.double()
        follows = self.follows(states)
        if follows is None:
            return self._rollout(states)
        return _moved(self._paths[follows], states[:, None])

    def braking(self, states: Tensor) -> Tensor:
        """Return states (..., B, 7) of braking from states (..., 7); the last is at rest."""
        flat = states.double().reshape(-1, 7)
        follows = self.follows(flat)
        if follows is None:
            return self._braking(states)
        return _moved(self._stops[follows], flat).view(*states.shape[:-1], *self._stops.shape[1:])

    def flights(self, states: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return `rollout` of states (N, 7), `braking` at its ends, and `follows`."""
        follows = self.follows(states)
        if follows is None:
            paths = self._rollout(states)
            return paths, self.braking(paths[:, :, -1]), None
        paths = _moved(self._paths[follows], states[:, None])
        return paths, _moved(self._stops, paths[:, :, -1]), follows

    def _longest_steps(self) -> Tensor:
        """Return the longest step (m) and largest turn (rad) of the motions after each primitive, (P, 2)."""
        rest = _moved(self._stops.expand(len(self), *self._stops.shape), self._paths[:, :, -1])
        states = torch.cat([torch.zeros_like(rest[..., :1, :]), self._paths, rest], -2)[..., :4]
        step = states[..., 1:, :] - states[..., :-1, :]
        length = step[..., :3].square().sum(-1).sqrt()
        return torch.stack([length.flatten(1).amax(1), step[..., 3].abs().flatten(1).amax(1)], 1)

    def follows(self, states: Tensor) -> Tensor | None:
        """Return the primitive (N,) with the velocities of each state (N, 7); None if a state has none."""
        is_end = (states[:, None, 4:] == self.commands).all(-1).numpy()
        return torch.from_numpy(is_end.argmax(1)) if is_end.any(1).all() else None

    def _rollout(self, states: Tensor) -> Tensor:
        return _integrated(states[:, None], self.commands, self.dynamics, self.dynamics.n_steps)

    def _braking(self, states: Tensor) -> Tensor:
        at_rest = torch.zeros(3, dtype=torch.float64)
        longest = int(_n_ramp_steps(_limits(self.dynamics), self.dynamics).max())
        return _integrated(states, at_rest, self.dynamics, longest)


def _limits(dynamics: Dynamics) -> Tensor:
    """The largest velocities (3,)."""
    return torch.tensor([dynamics.speed, dynamics.climb, dynamics.yaw_rate], dtype=torch.float64)


def _n_ramp_steps(change: Tensor, dynamics: Dynamics) -> Tensor:
    """Number of whole steps that changes (..., 3) of the velocities take."""
    rates = [dynamics.acceleration, dynamics.acceleration, dynamics.yaw_acceleration]
    per_step = torch.tensor(rates, dtype=torch.float64) * dynamics.step
    return (change.abs() / per_step - _ROUNDING).ceil()


def velocities(dynamics: Dynamics, states: Tensor, commands: Tensor, n_steps: int) -> Tensor:
    """Return velocities (..., n_steps + 1, 3) from those of states (..., 7) to the commands (..., 3).

    Each velocity changes linearly over the whole steps that the acceleration limit needs, then stays
    constant. It is therefore linear within every step. Raises `InvalidArgumentError` for states
    beyond the limits.
    """
    now, limits = states[..., 4:], _limits(dynamics)
    if not bool((now.abs() <= limits * (1 + _ROUNDING)).all()):  # also catches NaN
        worst = now.reshape(-1, 3).abs().amax(0).tolist()
        raise InvalidArgumentError(
            f"states have velocities up to {worst}; speed, climb and yaw_rate allow {limits.tolist()}."
        )
    change = commands - now
    n_ramp = _n_ramp_steps(change, dynamics).clamp_min(1)[..., None, :]
    time = torch.arange(n_steps + 1, dtype=torch.float64)[:, None]
    ramp = now[..., None, :] + change[..., None, :] * (time / n_ramp)
    return torch.where(time < n_ramp, ramp, commands[..., None, :])


def _moved(paths: Tensor, states: Tensor) -> Tensor:
    """Move paths (..., S, 7) that begin at the origin with yaw 0 to the poses of states (..., 7)."""
    x, y, z, yaw = states[..., None, :4].unbind(-1)
    along, across, up, turn, *velocities = paths.unbind(-1)
    cos, sin = yaw.cos(), yaw.sin()
    place = [x + cos * along - sin * across, y + sin * along + cos * across, up + z, turn + yaw]
    return torch.stack(torch.broadcast_tensors(*place, *velocities), -1)


def _integrated(states: Tensor, commands: Tensor, dynamics: Dynamics, n_steps: int) -> Tensor:
    """Return states (..., n_steps, 7) while velocities change from states (..., 7) to commands (..., 3)."""
    h = dynamics.step
    velocity = velocities(dynamics, states.double(), commands, n_steps)
    x, y, z, yaw = (states[..., i, None].double() for i in range(4))
    v, climb, turn = velocity.movedim(-1, 0).contiguous()  # each (..., n_steps + 1)
    yaw = yaw + _accumulated((turn[..., :-1] + turn[..., 1:]) * (h / 2))
    z = z + _accumulated((climb[..., :-1] + climb[..., 1:]) * (h / 2))
    dx, dy = torch.zeros_like(v[..., 1:]), torch.zeros_like(v[..., 1:])
    for node, weight in _QUADRATURE:
        heading = torch.lerp(turn[..., :-1], turn[..., 1:], node / 2) * (h * node) + yaw[..., :-1]
        speed = torch.lerp(v[..., :-1], v[..., 1:], node) * (h * weight)
        dx += speed * heading.cos()
        dy += speed * heading.sin()
    place = [x + dx.cumsum(-1), y + dy.cumsum(-1), z[..., 1:], yaw[..., 1:]]
    return torch.stack([*place, v[..., 1:], climb[..., 1:], turn[..., 1:]], -1)


def _accumulated(steps: Tensor) -> Tensor:
    """Return cumulative sums (..., n + 1) of steps (..., n), starting with 0."""
    return torch.nn.functional.pad(steps.cumsum(-1), (1, 0))
