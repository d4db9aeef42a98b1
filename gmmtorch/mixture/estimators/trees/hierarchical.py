"""HierarchicalGaussianMixture: a tree of Gaussians, whose leaves and whose every level are a mixture."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimator import MixtureEstimator
from gmmtorch.mixture.estimators.trees.growth import GrowthRule, grow
from gmmtorch.mixture.estimators.trees.mixture_tree import Tree, check_tree
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.validation import Array, RandomState, as_generator, check_choice, check_number


class HierarchicalGaussianMixture(MixtureEstimator):
    """Hierarchical EM (thesis 2.1.2, equations 2.7–2.9; Eckart et al., 2016): a tree of Gaussians.

    The cloud is split into at most `branching` Gaussians by EM, the points of each into as many
    again, and so on: all nodes of a level in one batch. A point goes to every child that is nearly
    as likely as its likeliest one, and takes a share of its weight to each. The leaves, weighted by
    their paths, are the mixture; `level` gives coarser ones of the same cloud. What a point costs
    grows with the levels, not with the leaves.

    Args:
        n_components: leaves at most. Where they do not suffice to split all nodes of a level, those
            are split that gain most. None: as many as the other limits make.
        branching: children of a node at most.
        max_levels: levels at most, so branching^max_levels leaves.
        tol: EM in a node stops when its mean log-likelihood rises by less (nats a point), and a
            node whose split gains less is not split.
        max_iter: EM iterations at most, on each level.
        reg_covar: added to each variance, in the square of the points' unit (m²).
        soft_threshold: λ_p, from 0 to 1: a point goes to the children of more than this share of its
            largest responsibility (2.7). 1: to the likeliest only.
        planarity_threshold: nodes whose smallest variance is a lesser share of all three are flat,
            and are not split (2.9).
        thickness: nor are those whose smallest standard deviation is less (m), such as the noise
            of the sensor.
        min_support: children of fewer points (weight) are dropped, and their points given to their
            siblings.
        min_gain: nats of log-likelihood that a split must gain for each free parameter that it
            adds: 1 is Akaike's criterion, ½ log N the Bayesian one, with 0 any gain will do.
        random_state: of `sample`; nothing in the fit is drawn at random. A seed, a `RandomState`, a
            `torch.Generator`, or None for a fresh one.
        dtype: of the E-step. With "float32", levels on which that would err too much are worked
            on in float64.

    Fitted attributes: those of every `MixtureEstimator`, of the leaves; and of the tree `n_levels_`,
    `node_parents_` (M,), −1 on the first level, `node_levels_` (M,), from 1, `node_weights_` (M,),
    `node_means_` (M, D), `node_covariances_` (M, D, D), level by level. Leaves are in the nodes'
    order. `lower_bounds_` are of the mean log-likelihood, nats: of one Gaussian, after each EM
    iteration on a level, and of each level as it is kept. They do not fall within a level's EM.
    """

    _extra_names: ClassVar[tuple[str, ...]] = (
        "node_parents",
        "node_weights",
        "node_means",
        "node_covariances",
    )
    _finds_n_components = True
    node_parents: Tensor
    node_weights: Tensor
    node_means: Tensor
    node_covariances: Tensor

    def __init__(
        self,
        n_components: int | None = None,
        *,
        branching: int = 8,
        max_levels: int = 4,
        tol: float = 1e-3,
        max_iter: int = 100,
        reg_covar: float = 1e-6,
        soft_threshold: float = 0.1,
        planarity_threshold: float = 0.0,
        thickness: float = 0.0,
        min_support: float = 4.0,
        min_gain: float = 1.0,
        random_state: RandomState = None,
        dtype: str = "float32",
    ) -> None:
        nn.Module.__init__(self)
        self.n_components = n_components
        self.branching = branching
        self.max_levels = max_levels
        self.tol = tol
        self.max_iter = max_iter
        self.reg_covar = reg_covar
        self.soft_threshold = soft_threshold
        self.planarity_threshold = planarity_threshold
        self.thickness = thickness
        self.min_support = min_support
        self.min_gain = min_gain
        self.random_state = random_state
        self.dtype = dtype

    # -- learning ---------------------------------------------------------------------------------

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
    ) -> HierarchicalGaussianMixture:
        """Learn the tree of points X (N, D).

        Args:
            X: points, finite.
            y: ignored, as in scikit-learn.
            sample_weight: (N,) how many points each row stands for: not negative, not all zero.
            on_iteration: called with the iteration (from 1) and the lower bound, nats a point.

        Raises:
            InvalidArgumentError (a ValueError): a bad argument, weight or point.
            NumericalError: a component collapsed, as happens with reg_covar = 0.
        """
        points, weight, center = self._prepare(X, sample_weight)
        found = grow(points, weight, self._rule(), on_iteration)
        tree = found.tree._replace(means=found.tree.means + center)
        leaves = tree.leaves()
        mixture = Parameters(*(value[leaves] for value in found.tree[1:]))
        extra = dict(zip(self._extra_names, tree, strict=True))
        self._keep(mixture, center, found.lower_bounds, found.converged, extra)
        self._warn_unless_converged("EM", " in every node")
        return self

    def _rule(self) -> GrowthRule:
        given = {name: getattr(self, name) for name in GrowthRule.__dataclass_fields__}
        return GrowthRule(**{**given, "dtype": em.SOFTMAX_DTYPES[self.dtype]})

    # -- the tree ---------------------------------------------------------------------------------

    def level(self, level: int) -> GaussianMixture:
        """The nodes of a level, from 1 to `n_levels_`, and the leaves above it, as a mixture of the cloud.

        Raises `InvalidArgumentError` for a level that there is not.
        """
        tree, deepest = self._tree(), self.n_levels_
        if check_whole("level", level, 1) > deepest:
            raise InvalidArgumentError(f"level={level} must be at most n_levels_={deepest}.")
        nodes = tree.at_level(level)
        weights = tree.weights[nodes]
        mixture = GaussianMixture.from_parameters(
            weights / weights.sum(),
            tree.means[nodes],
            tree.covariances[nodes],
            converged=self.converged_,
            random_state=self.random_state,
        )
        mixture._tensors = self._tensors
        return mixture

    def _tree(self) -> Tree:
        """The tree; for a mixture of given parameters, one level of leaves."""
        self._fitted()
        if "node_parents" in self._buffers:
            return Tree(self.node_parents, self.node_weights, self.node_means, self.node_covariances)
        return Tree(
            torch.full(self.weights.shape, -1, device=self.weights.device),
            self.weights,
            self.means,
            self.covariances,
        )

    @property
    def n_levels_(self) -> int:
        """How many levels there are."""
        return int(self._tree().levels().max())

    @property
    def node_parents_(self) -> Array:
        """The parent (M,) of each node, −1 on the first level."""
        return self._as_fitted(self._tree().parents)

    @property
    def node_levels_(self) -> Array:
        """The level (M,) of each node, from 1."""
        return self._as_fitted(self._tree().levels())

    @property
    def node_weights_(self) -> Array:
        """The share (M,) of the cloud in each node."""
        return self._as_fitted(self._tree().weights)

    @property
    def node_means_(self) -> Array:
        """Means (M, D) of the nodes."""
        return self._as_fitted(self._tree().means)

    @property
    def node_covariances_(self) -> Array:
        """Covariances (M, D, D) of the nodes."""
        return self._as_fitted(self._tree().covariances)

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        if tensors:
            missing = [name for name in self._extra_names if name not in tensors]
            if missing:
                raise InvalidArgumentError(f"The tree lacks {missing[0]}; give all of it or nothing.")
            check_tree(Tree(*(tensors[name] for name in self._extra_names)), self.weights)
        super()._set_extra(tensors)

    def _moved_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        extra = self._extra_tensors()
        if extra:
            extra["node_means"] = extra["node_means"] @ rotation.T + translation
            extra["node_covariances"] = rotation @ extra["node_covariances"] @ rotation.T
        return extra

    # -- arguments --------------------------------------------------------------------------------

    def check_parameters(self, n_points: int | None = None) -> None:
        """Raise `InvalidArgumentError` for a parameter that cannot be."""
        if self.n_components is not None:
            check_whole("n_components", self.n_components, 1)
        for name, least in (("branching", 2), ("max_levels", 1), ("max_iter", 1)):
            check_whole(name, getattr(self, name), least)
        for name in ("tol", "reg_covar", "planarity_threshold", "thickness", "min_support", "min_gain"):
            check_number(name, getattr(self, name))
        check_number("soft_threshold", self.soft_threshold, most=1.0)
        check_choice("dtype", self.dtype, em.SOFTMAX_DTYPES)
        as_generator(self.random_state)
