"""A mixture's file: safetensors, checked as it is read."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes

_FILE_KIND, _FILE_VERSION = "gmmtorch.mixture", 1
_EXTRA = "extra."  # before the names of the tensors that not every mixture has
_EXTRA_DTYPES = (torch.float64, torch.int64, torch.bool)


class StoredMixture(NamedTuple):
    """What the file holds: weights (K,), means (K, D), covariances (K, D, D), and how they were found.

    arrays: whether the points were arrays; parameters: the estimator's, those that JSON can hold;
    extra: what an estimator keeps beside the mixture (a posterior, a tree), float64, int64 or bool.
    """

    weights: Tensor
    means: Tensor
    covariances: Tensor
    lower_bounds: Sequence[float]
    converged: bool
    arrays: bool
    parameters: dict[str, Any]
    extra: Mapping[str, Tensor] = MappingProxyType({})


def write(path: str | Path, mixture: StoredMixture) -> None:
    """Write the file, atomically."""
    facts = mixture._asdict()
    tensors = {name: facts.pop(name) for name in ("weights", "means", "covariances")}
    tensors |= {_EXTRA + name: value for name, value in facts.pop("extra").items()}
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))


def read(path: str | Path) -> StoredMixture:
    """Read the file. Raises `DataError` unless its tensors have the shapes of a mixture's.

    Whether they are one (weights that add up to one, definite covariances), and what the shapes of
    the extra tensors mean, is left to who uses them.
    """
    tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
    means = require(tensors, "means", (None, None), torch.float64, path)
    k, dim = means.shape
    weights = require(tensors, "weights", (k,), torch.float64, path)
    covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
    extra = {
        name.removeprefix(_EXTRA): _require_extra(tensors, name, path)
        for name in tensors
        if name.startswith(_EXTRA)
    }
    with naming(path):
        return StoredMixture(
            weights,
            means,
            covariances,
            [float(x) for x in facts["lower_bounds"]],
            bool(facts["converged"]),
            bool(facts["arrays"]),
            dict(facts["parameters"]),
            extra,
        )


def _require_extra(tensors: Mapping[str, Tensor], name: str, path: str | Path) -> Tensor:
    """A tensor of any shape, finite, of a type that `write` is given."""
    tensor = tensors[name]
    if tensor.dtype not in _EXTRA_DTYPES:
        raise DataError(f"{path}: {name} is {tensor.dtype}; expected one of {_EXTRA_DTYPES}.")
    return require(tensors, name, (None,) * tensor.ndim, tensor.dtype, path)


@contextmanager
def naming(path: str | Path) -> Iterator[None]:
    """Whatever is wrong with what a file holds becomes a `DataError` that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, GmmTorchError) as error:
        raise DataError(f"{path} does not hold a mixture: {error}") from error
