"""Checkpoints of a long fit: a file with its state, from which a later run continues."""

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

RunFacts = Mapping[str, Any]
"""Description of a run, in JSON types: settings and cloud, including n_components and dimensions."""


class State(NamedTuple):
    """Parameters relative to `center` (D,), and the lower bounds (nats) of the iterations so far."""

    parameters: Parameters
    center: Tensor
    lower_bounds: list[float]

    def pack(self) -> Tensor:
        """The state as one vector (n,), float64."""
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
    """A file in which a fit stores its state.

    Args:
        path: the safetensors file, written atomically.
        every: iterations between two writes.
        seconds: also write after this time since the last write; None: no time limit.
        resume: continue from the file if it exists. Without it, an existing file is an error.
    """

    path: Path
    every: int = 10
    seconds: float | None = None
    resume: bool = False

    def __post_init__(self) -> None:
        check_whole("every", self.every, 1)
        if self.seconds is not None and not (math.isfinite(self.seconds) and self.seconds > 0):
            raise InvalidArgumentError(f"seconds={self.seconds} must be above zero and finite, or None.")

    def read(self, run: RunFacts) -> State | None:
        """The state to continue from; None if there is none.

        Raises `InvalidArgumentError` if the file is of another run, or exists without `resume`, and
        `DataError` if the file is damaged.
        """
        if not self.path.exists():
            return None
        if not self.resume:
            raise InvalidArgumentError(
                f"checkpoint={self.path} already exists; continue from it with resume=true, or delete it."
            )
        state, facts = read_state(self.path)
        for name in dict.fromkeys([*run, *facts]):
            if facts.get(name) != run.get(name):
                raise InvalidArgumentError(
                    f"checkpoint={self.path} is of another run: it has {name}={facts.get(name)!r}, this run "
                    f"has {name}={run.get(name)!r}. Use the same value, or another checkpoint."
                )
        if tuple(state.parameters.means.shape) != (run["n_components"], run["dimensions"]):
            raise DataError(f"{self.path} does not match its own description; the file is damaged.")
        return state

    def resume_hint(self) -> str:
        """A sentence that says how to continue."""
        try:
            state, _ = read_state(self.path)
        except GmmTorchError:
            return f"There is no checkpoint at {self.path} yet; start the run again."
        return (
            f"The last checkpoint, {self.path}, is of iteration {len(state.lower_bounds)}; start the run "
            "again with resume=true to continue from it."
        )


class CheckpointWriter:
    """Writes the state of one run when it is due."""

    def __init__(self, checkpoint: Checkpoint, run: RunFacts, center: Tensor) -> None:
        self._checkpoint, self._run, self._center = checkpoint, run, center
        self._last = time.monotonic()

    def write_if_due(self, parameters: Parameters, lower_bounds: list[float], final: bool = False) -> None:
        """Write the state after an iteration if it is due, or if it is `final`."""
        seconds, now = self._checkpoint.seconds, time.monotonic()
        is_late = seconds is not None and now - self._last >= seconds
        if final or is_late or len(lower_bounds) % self._checkpoint.every == 0:
            write_state(self._checkpoint.path, State(parameters, self._center, lower_bounds), self._run)
            self._last = now


def write_state(path: Path, state: State, run: RunFacts) -> None:
    """Write a state and a description of its run, atomically."""
    tensors = {**state.parameters._asdict(), "center": state.center}
    tensors["lower_bounds"] = torch.tensor(state.lower_bounds, dtype=torch.float64)
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, run=dict(run)))


def read_state(path: Path) -> tuple[State, dict[str, Any]]:
    """The state and the description of its run. Raises `DataError` if the file is not a checkpoint."""
    tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
    means = require(tensors, "means", (None, None), torch.float64, path)
    k, dim = means.shape
    weights = require(tensors, "weights", (k,), torch.float64, path)
    covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
    center = require(tensors, "center", (dim,), torch.float64, path)
    bounds = require(tensors, "lower_bounds", (None,), torch.float64, path)
    run = facts.get("run")
    if not isinstance(run, dict):
        raise DataError(f"{path} lacks the description of its run; the file is damaged.")
    return State(Parameters(weights, means, covariances), center, bounds.tolist()), run
