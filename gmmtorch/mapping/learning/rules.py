"""Learning rules: how scans become components of a map. Importing this file does not load torch."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal, NamedTuple, get_args

from gmmtorch.declarations import option
from gmmtorch.errors import (
    InvalidArgumentError,
    check_choice,
    check_number,
    check_prior,
    check_resolution,
    check_whole,
)
from gmmtorch.mixture import Prune, PruneOptions

if TYPE_CHECKING:
    from gmmtorch.mapping.learning.fitting import DepthFrame
    from gmmtorch.scan import Scan

FORGET_OFF, CONTRADICTION = "off", "contradiction"
LearnerName = Literal["flat_pieces", "hierarchical"]

SOFTMAX_DTYPES = ("float32", "float64")
"""Names of the types in which EM can compute exponentials."""


@dataclass(frozen=True)
class NoveltyRule:
    """When a beam is novel, and when a component explains a point (thesis 4.1).

    resolution: side (m) of the cells whose entropy is compared.
    threshold: a beam is novel if it lowers the entropy of its cells by at least this many bits.
    observed: a cell is observed if hits + misses reach this number of rays. A beam through an unobserved
        cell is novel.
    prior, cutoff: options of the evidence, see `occupancy_probability` and `point_evidence`.
    explained: a component explains points within this squared Mahalanobis distance (d_ll of the thesis).
        None: the 95 % quantile of χ² with D degrees of freedom.
    distance: a component explains the free space of a beam only if one of its sensor origins is within
        this distance (m) of the sensor (d_s of the thesis).
    distance_for: beams to which `distance` applies. all: every beam. free_space: no-return beams, and beams
        that are novel by the cells before their ends, as in the thesis.
    """

    resolution: float = 0.1
    threshold: float = 1.0
    observed: float = 1.0
    prior: float = 1.0
    cutoff: float = 5.0
    explained: float | None = None
    distance: float = 0.5
    distance_for: str = "all"

    def __post_init__(self) -> None:
        check_resolution(self.resolution)
        check_prior(self.prior)
        check_choice("distance_for", self.distance_for, ("all", "free_space"))
        for name in ("threshold", "observed", "distance"):
            check_number(name, getattr(self, name))
        check_number("cutoff", self.cutoff, above=True)
        if self.explained is not None:
            check_number("explained", self.explained, above=True)


class IntensityLaw(NamedTuple):
    """How intensities depend on range and incidence, see `attributes.reflectivity`; estimated from n beams.

    reference: the range (m) of reflectivities. rr to ii: sums of squares and products within components of
        the logarithms of range (r), cosine of the incidence (c) and intensity (i).
    """

    reference: float
    n: float
    rr: float
    rc: float
    cc: float
    ri: float
    ci: float
    ii: float

    @property
    def is_valid(self) -> bool:
        """Whether all values are finite numbers, and the range is above 0."""
        return all(isinstance(x, float | int) and math.isfinite(x) for x in self) and self.reference > 0

    @property
    def exponents(self) -> tuple[float, float]:
        """Of the range and of the cosine. Least squares with a normal prior of deviation 2, the size of those
        of a small target (−4, 0) and of a matt surface (−2, 1); it counts where beams do not tell them apart.
        """
        prior = self.ii / (4 * max(self.n, 1))
        rr, cc = self.rr + prior, self.cc + prior
        area = rr * cc - self.rc**2
        if not area > 0:
            return 0.0, 0.0
        return (cc * self.ri - self.rc * self.ci) / area, (rr * self.ci - self.rc * self.ri) / area


@dataclass(frozen=True, kw_only=True)
class MixtureRule(PruneOptions):
    """How the mixture of a window is learned. Components of no-return beams are not pruned.

    learner: "flat_pieces", EM that starts from flat pieces, or "hierarchical", the leaves of a tree of
        mixtures (thesis 2.1.2).
    planarity: the tree does not split a node whose smallest variance is a smaller share of the sum of its
        variances (2.9). None: it does not split a node that is at most as thick as a flat piece.
    free_points: number of points at equal distances on each beam with a return, from which components of free
        space are learned, as from the ends of no-return beams (thesis 3.5).
    reflectivity: True: the channel "intensity" of the map is the reflectivity, by a law of range and
        incidence that is estimated from all windows so far; the law is then the value. False: as measured.
    """

    prune: Prune = "none"
    learner: LearnerName = "flat_pieces"
    planarity: float | None = None
    free_points: int = 0
    reflectivity: bool | IntensityLaw = False
    forget: int | float | str = option(
        FORGET_OFF,
        "what leaves the map. off: nothing; contradiction: surfaces that later beams pass through; a number: "
        "all evidence, with this half-life (s) of the scans' times",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("learner", self.learner, get_args(LearnerName))
        if self.planarity is not None:
            check_number("planarity", self.planarity, largest=1.0, above=True)
        check_whole("free_points", self.free_points, 0)
        law = self.reflectivity
        if not isinstance(law, bool) and not (isinstance(law, IntensityLaw) and law.is_valid):
            raise InvalidArgumentError(
                f"reflectivity={law!r}: give True or False, or the law of another map."
            )
        if self.forget is False:  # YAML reads `off` as False
            object.__setattr__(self, "forget", FORGET_OFF)
        if isinstance(self.forget, str | bool):
            check_choice("forget", self.forget, (FORGET_OFF, CONTRADICTION, "a half-life in seconds"))
        else:
            check_number("forget", self.forget, above=True)

    @property
    def needs_points(self) -> bool:
        """Whether learning needs the points of depth images, and not only their sums over cells."""
        return self.learner != "flat_pieces" or self.prune != "none" or self.free_points > 0


@dataclass(frozen=True)
class WindowedRule(MixtureRule):
    """Learns a mixture from every window of scans and adds it to the map; nothing is merged.

    length: largest standard deviation (m) along a component.
    min_points: fewest points of a component. None: 6 in 2D, 20 in 3D.
    max_origins: largest number of sensor origins of a component, sampled by their counts.
    iterations: EM iterations. EM starts from the flat pieces and needs few.
    max_cells: clouds with more points than this are first summed into cells.
    dtype: type of the exponentials in EM, "float32" or "float64".
    """

    kind: ClassVar[str] = "windowed"

    noise: float = option(
        0.01,
        "standard deviation (m) of the range sensor. Its square is the smallest variance of a component; a "
        "piece is flat if it is at most twice as thick",
    )
    length: float = 0.3
    min_points: float | None = None
    n_components: int | None = option(
        None, "components of a window, at most; null: as many as its surfaces need"
    )
    max_origins: int = 8
    iterations: int = 5
    max_cells: int = 20_000
    window: int = option(20, "number of neighbouring scans that are learned together")
    dtype: str = "float32"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("noise", "length"):
            check_number(name, getattr(self, name), above=True)
        for name in ("max_origins", "iterations", "max_cells", "window"):
            check_whole(name, getattr(self, name), 1)
        if self.n_components is not None:
            check_whole("n_components", self.n_components, 1)
        if self.min_points is not None:
            check_number("min_points", self.min_points, least=1)
        check_choice("dtype", self.dtype, SOFTMAX_DTYPES)

    def fitted(self, scans: Sequence[Scan | DepthFrame]) -> WindowedRule:
        """The rule itself: none of its options is derived from scans."""
        return self


@dataclass(frozen=True)
class IncrementalRule(MixtureRule):
    """Learns components from every window of scans, adds them, and merges the map under a budget.

    Options that are None are derived from the first scans, see `fitted`.

    length: largest standard deviation (m) along a component when it is learned; merging may exceed it.
    cell: side (m) of the cells into which points are summed before EM.
    window_components: largest number of components of a window.
    iterations: EM iterations on the cells of a window.
    max_origins, mean_origins: largest and mean number of sensor origins of a component, see `limit_origins`.
    """

    kind: ClassVar[str] = "incremental"

    noise: float | None = option(
        None,
        "standard deviation (m) of the range sensor, which defines flat pieces; null: derived from the "
        "median range of the first scans",
    )
    length: float | None = None
    cell: float | None = None
    window: int | None = option(
        None, "number of neighbouring scans that are learned together; null: derived, as noise"
    )
    window_components: int = 500
    iterations: int = 6
    n_components: int | None = option(None, "components of the whole map, at most; null: no limit")
    max_bytes: int | None = option(None, "bytes of the map's file, at most; null: no limit")
    max_origins: int = 8
    mean_origins: float | None = 2.0
    max_cost: float | None = None
    novelty: NoveltyRule | None = option(
        None,
        "null: learn from all beams; {} or options of NoveltyRule: learn from novel beams only, and count "
        "explained points to the components that explain them (thesis 4.1.2)",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("noise", "length", "cell"):
            if getattr(self, name) is not None:
                check_number(name, getattr(self, name), above=True)
        for name in ("window_components", "iterations", "max_origins"):
            check_whole(name, getattr(self, name), 1)
        for name in ("window", "n_components", "max_bytes"):
            if getattr(self, name) is not None:
                check_whole(name, getattr(self, name), 1)
        if self.mean_origins is not None:
            check_number("mean_origins", self.mean_origins, least=1)
        if self.max_cost is not None and not 0 <= self.max_cost < 1:
            raise InvalidArgumentError(
                f"max_cost={self.max_cost} must be at least 0 (equal) and below 1 (no overlap)."
            )

    def fitted(self, scans: Sequence[Scan | DepthFrame]) -> IncrementalRule:
        """The rule with every None among noise, length, cell and window derived from scans.

        Sensors differ in scale. Lengths are fixed fractions of the median range r of the scans, measured on
        a depth camera, two lidars and a laser. A window holds as many scans as contain enough points to
        learn surfaces from. Returns the rule itself if it is complete or no scan has a return.
        """
        import torch

        from gmmtorch.scan import Scan

        if None not in (self.noise, self.length, self.cell, self.window):
            return self
        found = [
            (scan.points - scan.origin).norm(dim=1) if isinstance(scan, Scan) else scan.ranges
            for scan in scans
        ]
        ranges = [distances for distances in found if len(distances)]
        if not ranges:
            return self
        r = max(float(torch.cat(ranges).median()), _LEAST_RANGE)
        fractions, window_points = _SCALES[scans[0].dim]
        # Three digits take few bytes in a file.
        derived: dict[str, Any] = {name: float(f"{r * share:.3g}") for name, share in fractions.items()}
        points_per_scan = sum(map(len, ranges)) / len(ranges)
        derived["window"] = max(8, min(40, round(window_points / points_per_scan)))
        return replace(self, **{n: value for n, value in derived.items() if getattr(self, n) is None})


LearningRule = WindowedRule | IncrementalRule
"""How scans become components. `kind` is the rule's name in files."""

_RULES: dict[str, type[LearningRule]] = {rule.kind: rule for rule in (WindowedRule, IncrementalRule)}


def rule_facts(rule: LearningRule) -> dict[str, Any]:
    """The rule as plain values: its kind, and its options that differ from the defaults."""
    return {"kind": rule.kind, **changed_options(rule, type(rule)())}


def read_rule(kind: str, novelty: dict[str, Any] | None = None, **options: Any) -> LearningRule:
    """The rule of given `rule_facts`. Raises `KeyError`, `TypeError` or `ValueError` for other facts."""
    if novelty is not None:
        options["novelty"] = NoveltyRule(**novelty)
    if isinstance(options.get("reflectivity"), list | tuple):
        options["reflectivity"] = IntensityLaw(*options["reflectivity"])
    return _RULES[kind](**options)


def changed_options(options: Any, defaults: Any, leave_out: Sequence[str] = ()) -> dict[str, Any]:
    """The fields of the dataclass `options` that differ from those of `defaults`."""
    plain = asdict(defaults)
    return {k: v for k, v in asdict(options).items() if v != plain[k] and k not in leave_out}


_SCALES = {
    2: ({"noise": 1 / 175, "length": 1 / 12, "cell": 1 / 175}, 5e3),
    3: ({"noise": 1 / 350, "length": 1 / 4, "cell": 1 / 40}, 2e5),
}
"""Lengths as fractions of the median range, and points of a window."""
_LEAST_RANGE = 0.01  # metres
