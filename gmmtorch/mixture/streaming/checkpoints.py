"""Where a long fit has got to, kept in a file from which it goes on as if it had never stopped."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.mixture.em.exact import Parameters

_FILE_KIND, _FILE_VERSION = "gmmtorch.checkpoint", 1

Facts = Mapping[str, Any]
"""What tells a run from others: its settings and its cloud, in JSON's types; n_components and dimensions."""


class State(NamedTuple):
    """Parameters about `center` (D,), and the lower bounds (nats) of the iterations that led to them."""

    parameters: Parameters
    center: Tensor
    lower_bounds: list[float]

    def pack(self) -> Tensor:
        """As one vector (n,), float64."""
        bounds = self.center.new_tensor(self.lower_bounds)
        return torch.cat([part.flatten() for part in (*self.parameters, self.center, bounds)])

    @staticmethod
    def unpack(vector: Tensor, n_components: int, dim: int) -> State:
        """The inverse of `pack`."""
        k = n_components
        sizes = [k, k * dim, k * dim * dim, dim]
        weights, means, covariances, center, bounds = vector.split([*sizes, vector.numel() - sum(sizes)])
        parameters = Parameters(weights, means.view(k, dim), covariances.view(k, dim, dim))
        return State(parameters, center, bounds.tolist())


@dataclass(frozen=True)
class Checkpoint:
    """A file that a fit keeps its state in.

    Args:
        path: the file, safetensors; written whole or not at all.
        every: iterations between two writes.
        seconds: as many seconds after the last write, it is written all the same; None: never.
        resume: go on from the file, if it is there. Without it, a file that is there is an error.
    """

    path: Path
    every: int = 10
    seconds: float | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        check_whole("every", self.every, 1)
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise InvalidArgumentError(f"seconds={self.seconds} must be above zero, or None.")

    def read(self, run: Facts) -> State | None:
        """The state to go on from; None: there is none.

        Raises `InvalidArgumentError` if there is one of another run, or one that nobody asked to go on
        from, and `DataError` for a damaged file.
        """
        if not self.path.exists():
            return None
        if not self.resume:
            raise InvalidArgumentError(
                f"checkpoint={self.path} exists already; go on from it with resume=true, or delete it."
            )
        state, facts = read_state(self.path)
        for name in dict.fromkeys([*run, *facts]):
            if facts.get(name) != run.get(name):
                raise InvalidArgumentError(
                    f"checkpoint={self.path} is of another run: it has {name}={facts.get(name)!r}, this one "
                    f"{name}={run.get(name)!r}. Make them the same, or give another checkpoint."
                )
        if tuple(state.parameters.means.shape) != (run["n_components"], run["dimensions"]):
            raise DataError(f"{self.path} holds other parameters than it says; the file is damaged.")
        return state

    def advice(self) -> str:
        """Where to go on from, in words."""
        try:
            state, _ = read_state(self.path)
        except GmmTorchError:
            return f"There is no checkpoint at {self.path} yet; start again."
        return (
            f"The last checkpoint, {self.path}, is of iteration {len(state.lower_bounds)}; start again "
            "with resume=true to go on from there."
        )


class CheckpointWriter:
    """Writes the state of one run when it is due."""

    def __init__(self, checkpoint: Checkpoint, run: Facts, center: Tensor) -> None:
        self._checkpoint, self._run, self._center = checkpoint, run, center
        self._last = time.monotonic()

    def offer(self, parameters: Parameters, lower_bounds: list[float], final: bool = False) -> None:
        """Write the state after an iteration if it is due, or the `final` one."""
        seconds, now = self._checkpoint.seconds, time.monotonic()
        late = seconds is not None and now - self._last >= seconds
        if final or late or len(lower_bounds) % self._checkpoint.every == 0:
            write_state(self._checkpoint.path, State(parameters, self._center, lower_bounds), self._run)
            self._last = now


def write_state(path: Path, state: State, run: Facts) -> None:
    """Write a state and the run it is of, atomically."""
    tensors = {**state.parameters._asdict(), "center": state.center}
    tensors["lower_bounds"] = torch.tensor(state.lower_bounds, dtype=torch.float64)
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, run=dict(run)))


def read_state(path: Path) -> tuple[State, dict[str, Any]]:
    """The state and the run it is of. Raises `DataError` for a file that holds none."""
    tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
    means = require(tensors, "means", (None, None), torch.float64, path)
    k, dim = means.shape
    weights = require(tensors, "weights", (k,), torch.float64, path)
    covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
    center = require(tensors, "center", (dim,), torch.float64, path)
    bounds = require(tensors, "lower_bounds", (None,), torch.float64, path)
    run = facts.get("run")
    if not isinstance(run, dict):
        raise DataError(f"{path} does not say what run it is of; the file is damaged.")
    return State(Parameters(weights, means, covariances), center, bounds.tolist()), run
