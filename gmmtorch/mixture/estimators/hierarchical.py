"""HierarchicalGaussianMixture: a tree of Gaussians whose leaves, and whose levels, are mixtures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from numbers import Integral, Real
from typing import Any, ClassVar, NamedTuple

import torch
from sklearn.utils._param_validation import HasMethods, Interval
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.estimator import AT_LEAST_ZERO, COUNT, MixtureEstimator
from gmmtorch.mixture.estimators.sensor_model import SensorModel
from gmmtorch.mixture.estimators.tree_growth import Children, Members, Tree, grow, keep_children
from gmmtorch.mixture.gaussian_mixture import GaussianMixture
from gmmtorch.mixture.pruning import checked_origins, density_share
from gmmtorch.mixture.validation import Array, RandomState


def _node_attribute(read: Callable[[Tree], Tensor], doc: str) -> Any:
    """A fitted attribute, of the kind of the points given to `fit`."""
    return property(lambda mixture: mixture._as_fit_kind(read(mixture._tree())), doc=doc)


@dataclass(eq=False, repr=False)
class HierarchicalGaussianMixture(MixtureEstimator):
    """Hierarchical EM (thesis 2.1.2, equations 2.7–2.9; Eckart et al., 2016): a tree of Gaussians.

    EM splits the cloud into at most `branching` Gaussians, then splits the points of each Gaussian again,
    and so on. All nodes of a level are one batch. A point is assigned to every child that is nearly as
    likely as its most likely one, with a share of its weight for each. The leaves, weighted by their
    paths, are the mixture; `level` returns coarser mixtures of the same cloud. The cost of a point grows
    with the number of levels, not of leaves.

    Args:
        n_components: largest number of leaves. If it is too small to split all nodes of a level, the
            splits that gain most are made. None: limited by the other parameters only.
        branching: largest number of children of a node.
        max_levels: largest number of levels, so at most branching^max_levels leaves.
        tol: EM in a node stops when its mean log-likelihood increases by less (nats per point), and a
            split that gains less is not made.
        max_iter: largest number of EM iterations on each level.
        reg_covar: added to each variance, in the squared unit of the points (m²).
        soft_threshold: λ_p, from 0 to 1: a point is assigned to children with more than this share of
            its largest responsibility (2.7). With 1, to the most likely child only.
        planarity_threshold: a node whose smallest variance is a smaller share of the sum of its
            variances is flat and is not split (2.9).
        thickness: a node whose smallest standard deviation is less (m) is not split. The sensor's noise
            is a suitable value.
        min_support: children with less weight (points) are removed, and their points assigned to their
            siblings.
        min_density_share: children with a smaller share of the density of points that the sensor gives a
            surface are removed, and their points assigned to their siblings (2.1.4). If above zero, needs
            `sensor`, and the origins in `fit`.
        sensor: see `sensor_model`.
        min_gain: log-likelihood (nats) that a split must gain per free parameter that it adds. 1 is
            Akaike's criterion, ½ log N the Bayesian one, and 0 accepts any gain.
        random_state: used by `sample` only; the fit is deterministic. A seed, a `RandomState`, a
            `torch.Generator`, or None for a random seed.
        dtype: of the E-step. With "float32", levels on which its error is too large use float64.

    Fitted attributes: those of every `MixtureEstimator`, for the leaves; and for the tree `n_levels_`,
    `node_parents_` (M,), −1 on the first level, `node_levels_` (M,), from 1, `node_weights_` (M,),
    `node_means_` (M, D), `node_covariances_` (M, D, D), level by level. Leaves have the order of the
    nodes. `lower_bounds_` bound the mean log-likelihood, nats: of one Gaussian, after each EM iteration on
    a level, and of each accepted level. They do not decrease within the EM of a level.
    """

    _extra_names: ClassVar[tuple[str, ...]] = tuple(f"node_{name}" for name in Tree._fields)
    _finds_n_components = True
    _parameter_constraints: ClassVar[dict[str, list[Any]]] = {
        **MixtureEstimator._parameter_constraints,
        "n_components": [COUNT, None],
        "branching": [Interval(Integral, 2, None, closed="left")],
        "max_levels": [COUNT],
        "soft_threshold": [Interval(Real, 0, 1, closed="both")],
        "planarity_threshold": [AT_LEAST_ZERO],
        "thickness": [AT_LEAST_ZERO],
        "min_support": [AT_LEAST_ZERO],
        "min_density_share": [AT_LEAST_ZERO],
        "sensor": [HasMethods(["point_density"]), None],
        "min_gain": [AT_LEAST_ZERO],
    }
    node_parents: ClassVar[Tensor]  # buffers, which only a fitted tree has
    node_weights: ClassVar[Tensor]
    node_means: ClassVar[Tensor]
    node_covariances: ClassVar[Tensor]

    n_components: int | None = None
    _: KW_ONLY
    branching: int = 8
    max_levels: int = 4
    tol: float = 1e-3
    max_iter: int = 100
    reg_covar: float = 1e-6
    soft_threshold: float = 0.1
    planarity_threshold: float = 0.0
    thickness: float = 0.0
    min_support: float = 4.0
    min_density_share: float = 0.0
    sensor: SensorModel | None = None
    min_gain: float = 1.0
    random_state: RandomState = None
    dtype: str = "float32"

    def fit(
        self,
        X: Array,
        y: Any = None,
        sample_weight: Array | None = None,
        on_iteration: Callable[[int, float], None] | None = None,
        origins: ArrayLike | None = None,
    ) -> HierarchicalGaussianMixture:
        """Fit the tree to points X (N, D). Arguments and errors: see `MixtureEstimator.fit`.

        origins: (D,) or (S, D), sensor origins, for `min_density_share`; the nearest one is taken to have
        observed a component.
        """
        points, weight, center = self._prepare(X, sample_weight)
        limit = self._density_limit(origins, center)
        tree, bounds, converged = grow(points, weight, self, on_iteration, limit)
        leaves = tree.leaves()
        mixture = Parameters(*(value[leaves] for value in tree[1:]))
        extra = dict(zip(self._extra_names, tree._replace(means=tree.means + center), strict=True))
        self._store_fit(mixture, center, bounds, converged, extra)
        self._warn_unless_converged()
        return self

    def _density_limit(self, origins: ArrayLike | None, center: Tensor) -> DensityLimit | None:
        if self.min_density_share == 0:
            return None
        dim = center.shape[0]
        if self.sensor is None or origins is None or dim not in (2, 3):
            raise InvalidArgumentError(
                f"min_density_share={self.min_density_share} needs points in 2D or 3D (D = {dim}), sensor, "
                "and origins in fit."
            )
        return DensityLimit(self.min_density_share, self.sensor, checked_origins(origins, center) - center)

    def level(self, level: int) -> GaussianMixture:
        """The mixture of the nodes of a level (1 to `n_levels_`) and the leaves of earlier levels.

        Raises `InvalidArgumentError` for a level that does not exist.
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
        """The tree. A mixture of given parameters is a tree with one level of leaves."""
        self._fitted()
        if "node_parents" in self._buffers:
            return Tree(self.node_parents, self.node_weights, self.node_means, self.node_covariances)
        parents = torch.full(self.weights.shape, -1, device=self.weights.device)
        return Tree(parents, self.weights, self.means, self.covariances)

    @property
    def n_levels_(self) -> int:
        """Number of levels."""
        return int(self._tree().levels().max())

    node_parents_ = _node_attribute(
        lambda tree: tree.parents, "Parent (M,) of each node, −1 on the first level."
    )
    node_levels_ = _node_attribute(Tree.levels, "Level (M,) of each node, from 1.")
    node_weights_ = _node_attribute(lambda tree: tree.weights, "Share (M,) of the cloud in each node.")
    node_means_ = _node_attribute(lambda tree: tree.means, "Means (M, D) of the nodes.")
    node_covariances_ = _node_attribute(lambda tree: tree.covariances, "Covariances (M, D, D) of the nodes.")

    def _set_extra(self, tensors: Mapping[str, Tensor]) -> None:
        if tensors:
            missing = [name for name in self._extra_names if name not in tensors]
            if missing:
                raise InvalidArgumentError(f"The tree lacks {missing[0]}; pass all of its tensors, or none.")
            check_tree(Tree(*(tensors[name] for name in self._extra_names)), self.weights)
        super()._set_extra(tensors)

    def _transformed_extra(self, rotation: Tensor, translation: Tensor) -> dict[str, Tensor]:
        extra = self._extra_tensors()
        if extra:
            extra["node_means"] = extra["node_means"] @ rotation.T + translation
            extra["node_covariances"] = rotation @ extra["node_covariances"] @ rotation.T
        return extra


def check_tree(tree: Tree, leaf_weights: Tensor) -> None:
    """Raise `InvalidArgumentError` unless `tree` is a tree whose leaves have these weights (K,)."""
    parents, *values = tree
    n, dim = parents.numel(), tree.means.shape[-1] if tree.means.ndim else 0
    if parents.shape != (n,) or parents.dtype != torch.int64:
        raise InvalidArgumentError(
            f"parents is {parents.dtype} {tuple(parents.shape)}; expected (M,) whole numbers, int64."
        )
    for name, value, shape in zip(tree._fields[1:], values, ((n,), (n, dim), (n, dim, dim)), strict=True):
        if tuple(value.shape) != shape or value.dtype != torch.float64:
            raise InvalidArgumentError(
                f"{name} is {value.dtype} {tuple(value.shape)}; expected float64 {shape}."
            )
    if bool(((parents < -1) | (parents >= torch.arange(n, device=parents.device))).any()):
        raise InvalidArgumentError(
            f"parents={parents.tolist()} must be −1 or the index of an earlier node; order nodes by level."
        )
    leaves = tree.leaves()
    if leaves.shape != leaf_weights.shape or not torch.allclose(tree.weights[leaves], leaf_weights):
        raise InvalidArgumentError(
            f"The tree's {leaves.numel()} leaves are not the mixture's {len(leaf_weights)} components."
        )


class DensityLimit(NamedTuple):
    """When a child is too sparse for a surface.

    least: smallest share of the density of a surface. sensor: gives this density. origins: (S, D), relative
    to the centre of the cloud. seen: (N, S) points of each row of the cloud seen from each origin; None: the
    nearest origin has seen all of them.
    """

    least: float
    sensor: SensorModel
    origins: Tensor
    seen: Tensor | None = None

    def drop_sparse_children(self, children: Children, centers: Tensor, members: Members) -> Children:
        """Set sparse children of G nodes with centers (G, D) to weight 0, in favour of their siblings.

        members: of the children, which are numbered node · m + child.
        """
        found = children._replace(means=children.means + centers[:, None]).flat()
        support, counts = members.mass(len(found.weights)), None
        if self.seen is not None:
            seen = self.seen.index_select(0, members.point)
            seen = seen * (members.weight / seen.sum(1).clamp_min(torch.finfo(seen.dtype).tiny))[:, None]
            counts = seen.new_zeros(len(support), seen.shape[1]).index_add_(0, members.node, seen)
        share = density_share(support, found, self.sensor, self.origins, counts)
        return keep_children(children, (share >= self.least).view_as(children.weights))
