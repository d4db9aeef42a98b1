"""The safetensors file of a mixture: writing, and reading with checks."""

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
_EXTRA = "extra."  # prefix of the names of extra tensors
_EXTRA_DTYPES = (torch.float64, torch.int64, torch.bool)


class StoredMixture(NamedTuple):
    """Content of the file: weights (K,), means (K, D), covariances (K, D, D), and facts about the fit.

    arrays: whether the fitted points were arrays. parameters: the scalar options of the estimator.
    extra: further tensors of an estimator (a posterior, a tree), float64, int64 or bool.
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
    """Write the file atomically."""
    facts = mixture._asdict()
    tensors = {name: facts.pop(name) for name in ("weights", "means", "covariances")}
    tensors |= {_EXTRA + name: value for name, value in facts.pop("extra").items()}
    write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))


def read(path: str | Path) -> StoredMixture:
    """Read the file. Raises `DataError` unless its tensors have the shapes of a mixture.

    The caller checks the values (weights that add up to one, positive definite covariances) and the
    shapes of the extra tensors.
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
    with errors_naming(path):
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
    """An extra tensor.

    Raises `DataError` unless it is finite and of an allowed dtype; any shape is allowed.
    """
    tensor = tensors[name]
    if tensor.dtype not in _EXTRA_DTYPES:
        raise DataError(f"{path}: {name} is {tensor.dtype}; expected one of {_EXTRA_DTYPES}.")
    return require(tensors, name, (None,) * tensor.ndim, tensor.dtype, path)


@contextmanager
def errors_naming(path: str | Path) -> Iterator[None]:
    """Turns errors about the content of a file into a `DataError` that names the file."""
    try:
        yield
    except (KeyError, TypeError, ValueError, GmmTorchError) as error:
        raise DataError(f"{path} does not hold a mixture: {error}") from error
