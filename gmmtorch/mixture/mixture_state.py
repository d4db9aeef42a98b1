"""MixtureState: parameters, history and further tensors of a fitted mixture; motions, states and files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, TypeVar, cast

import numpy as np
import torch
from sklearn.base import BaseEstimator
from torch import Tensor

from gmmtorch.arrays import as_tensor
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, NumericalError
from gmmtorch.files import pack_tensors, read_tensors, require, write_bytes
from gmmtorch.linalg import check_symmetric, safe_cholesky
from gmmtorch.mixture.density import MixtureDensity
from gmmtorch.mixture.em.covariance_types import check_type, compact, type_shape
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.validation import Array, checked_parameter
from gmmtorch.pose import Pose

_FILE_KIND, _FILE_VERSION = "gmmtorch.mixture", 1
_EXTRA = "extra."  # prefix of the names of extra tensors in a file
_FITTED = (
    *("_tensors", "n_features_in_", "feature_names_in_"),
    *("lower_bounds_", "lower_bound_", "n_iter_", "converged_"),
)
_EXTRA_DTYPES = (torch.float64, torch.int64, torch.bool)


Self = TypeVar("Self", bound="MixtureState")


class MixtureState(MixtureDensity):
    """What a fit leaves behind: made from given parameters, copied, moved, stored and loaded.

    Further tensors of a subclass (a posterior, a tree) are buffers that `_extra_names` lists.
    """

    n_components: Any  # a whole number; None if a subclass determines it
    _extra_names: ClassVar[tuple[str, ...]] = ()  # buffers besides weights, means and covariances
    _finds_n_components: ClassVar[bool] = False  # whether n_components is only an upper limit

    @classmethod
    def from_parameters(
        cls: type[Self],
        weights: Array,
        means: Array,
        covariances: Array,
        *,
        lower_bounds: Sequence[float] = (),
        converged: bool = True,
        **options: Any,
    ) -> Self:
        """A fitted mixture with given weights (K,), means (K, D) and covariances.

        The covariances are (K, D, D), or have the shape of the covariance type. `lower_bounds` and
        `converged` describe the fit, if known; `options` are those of the constructor. Raises
        `InvalidArgumentError` or `NumericalError` for invalid parameters.
        """
        mean = as_tensor(means, "means", torch.float64)
        if mean.ndim != 2 or 0 in mean.shape:
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, D).")
        k, dim = mean.shape
        mixture = cls(**{"n_components": k, **options})
        kind = mixture.covariance_type
        is_full = len(np.shape(covariances)) == 3
        shape = (k, dim, dim) if is_full else type_shape(kind, k, dim)
        weight = checked_parameter(weights, (k,), "weights", mean.device)
        mean = checked_parameter(means, (k, dim), "means", mean.device)
        covariance = checked_parameter(covariances, shape, "covariances", mean.device)
        if bool((weight < 0).any()) or abs(float(weight.sum()) - 1) > 1e-6:
            raise InvalidArgumentError(f"weights={weight.tolist()} must be at least zero and add up to one.")
        if is_full:
            covariance = compact(check_type(check_symmetric(covariance, "covariances"), kind), kind)
        if kind in ("full", "tied"):
            safe_cholesky(check_symmetric(covariance.view(-1, dim, dim), "covariances"))
        elif not bool((covariance > 0).all()):
            raise NumericalError(
                f"covariances has {float(covariance.min()):.3g}; variances must be above zero."
            )
        mixture._tensors = isinstance(means, Tensor)
        mixture.n_features_in_ = dim
        mixture._set_history(lower_bounds, converged)
        mixture._set_buffers(weight, mean, covariance)
        mixture._set_extra({})
        return mixture

    def _set_history(self, lower_bounds: Sequence[float], converged: bool) -> None:
        self.lower_bounds_ = [float(x) for x in lower_bounds]
        self.lower_bound_ = self.lower_bounds_[-1] if self.lower_bounds_ else -math.inf
        self.n_iter_ = len(self.lower_bounds_)
        self.converged_ = bool(converged)

    # -- extra tensors of a subclass --------------------------------------------------------------

    def _extra_tensors(self) -> dict[str, Tensor]:
        """The existing tensors of `_extra_names`: float64, int64 or bool."""
        return {name: getattr(self, name) for name in self._extra_names if name in self._buffers}

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        """Replace the extra tensors. Called after the weights, means and covariances are set.

        The tensors may come from a file or a state dict, so a subclass checks them first and raises
        `InvalidArgumentError`. An empty mapping is valid: a mixture of given parameters has none.
        """
        for name in self._extra_names:
            self._buffers.pop(name, None)
            if name in tensors:
                self.register_buffer(name, tensors[name])

    def _transformed_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        """The extra tensors after a rigid motion x ↦ R x + t. A subclass transforms those that need it."""
        return self._extra_tensors()

    # -- states, motions and files ----------------------------------------------------------------

    def _load_from_state_dict(self, state_dict: dict[str, Any], prefix: str, *rest: Any) -> None:
        """Load the state of a fitted mixture with any K and D, whether this one is fitted or not."""
        given = [state_dict.get(prefix + name) for name in Parameters._fields]
        if all(isinstance(value, Tensor) for value in given):
            weights, means, covariances = (cast(Tensor, value).double().clone() for value in given)
            if covariances.ndim == 3:
                check_type(covariances, self.covariance_type)
            self._set_buffers(weights, means, covariances)
            state_dict[prefix + "covariances"] = self._typed_covariances()
            self.n_features_in_ = means.shape[1]
            self.__dict__.pop("feature_names_in_", None)
            if self.n_components is not None:  # None means: determined by the fit
                self.n_components = means.shape[0]
            extra = ((name, state_dict.get(prefix + name)) for name in self._extra_names)
            self._set_extra({name: value.clone() for name, value in extra if isinstance(value, Tensor)})
            if not hasattr(self, "lower_bounds_"):
                self._tensors = True
                self._set_history((), True)
        super()._load_from_state_dict(state_dict, prefix, *rest)

    def _scalar_options(self) -> dict[str, Any]:
        """Constructor options that JSON can represent."""
        options = BaseEstimator.get_params(self, deep=False)
        return {key: value for key, value in options.items() if isinstance(value, int | float | str | None)}

    def moved(self: Self, transform: Array) -> Self:
        """A copy moved by a rigid motion (D+1, D+1): means R μ + t, covariances R Σ Rᵀ.

        A rotated diagonal covariance is not diagonal: the copy of a "diag" mixture has
        `covariance_type="full"`.
        """
        means = self._fitted()
        rotation, translation = Pose.checked(transform, means.shape[1], device=means.device).parts
        moved = type(self)(**BaseEstimator.get_params(self, deep=False))
        if self._fitted_type == "diag":
            moved.covariance_type = "full"
        moved.__dict__.update({name: vars(self)[name] for name in _FITTED if name in vars(self)})
        moved._set_buffers(
            self.weights.clone(), means @ rotation.T + translation, rotation @ self.covariances @ rotation.T
        )
        moved._set_extra({k: v.clone() for k, v in self._transformed_extra(rotation, translation).items()})
        return moved

    def save(self, path: str | Path) -> None:
        """Write the fitted mixture to a safetensors file, atomically."""
        self._fitted()
        tensors = {name: getattr(self, name) for name in Parameters._fields}
        tensors |= {_EXTRA + name: value for name, value in self._extra_tensors().items()}
        facts = {
            "lower_bounds": self.lower_bounds_,
            "converged": self.converged_,
            "arrays": not self._tensors,
            "parameters": self._scalar_options(),
        }
        if "feature_names_in_" in vars(self):
            facts["features"] = list(vars(self)["feature_names_in_"])
        write_bytes(path, pack_tensors(tensors, _FILE_KIND, _FILE_VERSION, **facts))

    @classmethod
    def load(cls: type[Self], path: str | Path) -> Self:
        """Read a mixture that `save` wrote. Raises `DataError` if the file is not a valid mixture."""
        tensors, facts = read_tensors(path, _FILE_KIND, _FILE_VERSION)
        means = require(tensors, "means", (None, None), torch.float64, path)
        k, dim = means.shape
        weights = require(tensors, "weights", (k,), torch.float64, path)
        covariances = require(tensors, "covariances", (k, dim, dim), torch.float64, path)
        extra = {}
        for name, tensor in tensors.items():
            if name.startswith(_EXTRA):
                if tensor.dtype not in _EXTRA_DTYPES:
                    raise DataError(f"{path}: {name} is {tensor.dtype}; expected one of {_EXTRA_DTYPES}.")
                shape = (None,) * tensor.ndim
                extra[name.removeprefix(_EXTRA)] = require(tensors, name, shape, tensor.dtype, path)
        known = set(cls._get_param_names())
        try:
            parameters = dict(facts["parameters"])
            stored_n = parameters.get("n_components", 0)
            if stored_n is not None and not (cls._finds_n_components and isinstance(stored_n, int)):
                known.remove("n_components")  # then it is the number of stored components
            mixture = cls.from_parameters(
                weights,
                means,
                covariances,
                lower_bounds=[float(x) for x in facts["lower_bounds"]],
                converged=bool(facts["converged"]),
                **{key: value for key, value in parameters.items() if key in known},
            )
            mixture._set_extra(extra)
            mixture._tensors = not facts["arrays"]
            names = facts.get("features", [])
            if names and [type(name) for name in names] != [str] * dim:
                raise DataError(f"features={names} are not the names of {dim} columns.")
            if names:
                mixture.__dict__["feature_names_in_"] = np.array(names, object)
        except (KeyError, TypeError, ValueError, GmmTorchError) as error:
            raise DataError(f"{path} does not hold a mixture: {error}") from error
        return mixture
