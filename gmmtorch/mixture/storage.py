"""A mixture's file: safetensors, checked as it is read."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes

_FILE_KIND, _FILE_VERSION = "gmmtorch.mixture", 1


class StoredMixture(NamedTuple):
    """What the file holds: weights (K,), means (K, D), covariances (K, D, D), and how they were found.

    arrays: whether the points were arrays; parameters: the estimator's, those that JSON can hold.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    lower_bounds: Sequence[float]
    converged: bool
    arrays: bool
    parameters: dict[str, Any]


def write(path: str | Path, mixture: StoredMixture) -> None:
    """Write the file, atomically."""
    facts = mixture._asdict()
    tensors = {name: facts.pop(name) for name in ("weights", "means", "covariances")}
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))


def read(path: str | Path) -> StoredMixture:
    """Read the file. Raises `DataError` unless its tensors have the shapes of a mixture's.

    Whether they are one (weights that add up to one, definite covariances) is left to who uses them.
    """
    tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
    means = require(tensors, "means", (None, None), torch.float64, path)
    k, dim = means.shape
    weights = require(tensors, "weights", (k,), torch.float64, path)
    covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
    with naming(path):
        return StoredMixture(
            weights,
            means,
            covariances,
            [float(x) for x in facts["lower_bounds"]],
            bool(facts["converged"]),
            bool(facts["arrays"]),
            dict(facts["parameters"]),
        )


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Whatever is wrong with what a file holds becomes a `DataError` that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, GmmTorchError) as error:
        raise DataError(f"{path} does not hold a mixture: {error}") from error
