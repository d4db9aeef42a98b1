"""Fitting of components to the scans of a window: the one learner of every map.

The points, or the pixels of depth images, are summed into small cells, the cells are cut into flat pieces,
and EM on the cells starts from the pieces (see `mixture.em`). Every point belongs to its most likely
component; the points of each scan in a component give the component's viewpoints.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike
from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.kernels import DepthCells, DepthViews, cell_features, depth_cells, range_sums
from gmmtorch.linalg import as_tensors, on_cpu
from gmmtorch.mapping.attributes.moments import Attributes, learned, of_scans
from gmmtorch.mapping.attributes.reflectivity import gain
from gmmtorch.mapping.components import UNNUMBERED, Components
from gmmtorch.mapping.learning.merging import AssignedViewpoints, AssignViewpoints
from gmmtorch.mapping.learning.rules import IntensityLaw, MixtureRule
from gmmtorch.mixture import (
    Cells,
    FlatnessRule,
    Parameters,
    Rows,
    coarsest_allowed,
    em_step,
    maximization,
    most_likely_component,
    partition,
    pool,
    pool_into_cells,
    run_em,
    shift_features,
)
from gmmtorch.occupancy import whitening
from gmmtorch.pinhole import check_intrinsics, metric_depth
from gmmtorch.pose import Pose
from gmmtorch.scan import INTENSITY, Scan

if TYPE_CHECKING:
    from gmmtorch.mixture import SensorModel


@dataclass(frozen=True, eq=False)
class DepthFrame:
    """A depth image (H, W) in metres, of which pixels at or beyond `max_range` (m), not above zero or not
    finite are left out; its pose, world ← camera, float64, on the CPU; f_x, f_y, c_x, c_y in pixels; and its
    name in errors.
    """

    depth: Tensor
    pose: Pose
    camera: tuple[float, float, float, float]
    max_range: float
    name: str = "frame"

    @classmethod
    def of(
        cls,
        depth: ArrayLike,
        pose: ArrayLike,
        intrinsics: ArrayLike,
        pixel_stride: int = 1,
        max_range: float = math.inf,
        depth_scale: float | None = None,
    ) -> DepthFrame:
        """Every `pixel_stride`-th pixel of every `pixel_stride`-th row of a depth image.

        Args:
            depth: (H, W), along the optical axis. depth_scale: its metres per unit; None: metres, in a
                floating type.
            pose: (4, 4), world ← camera.
            intrinsics: (3, 3), of the whole image.
        """
        image = metric_depth(depth, depth_scale).detach()
        (fx, _, cx), (_, fy, cy), _ = check_intrinsics(intrinsics, tuple(image.shape)).tolist()
        camera = fx / pixel_stride, fy / pixel_stride, cx / pixel_stride, cy / pixel_stride
        placed = Pose.checked(pose, 3, "pose", device="cpu")
        return cls(image[::pixel_stride, ::pixel_stride], placed, camera, max_range)

    @property
    def dim(self) -> int:
        return 3

    def to(self, device: torch.device | str | None) -> DepthFrame:
        """The frame with its image on another device. None: where it is."""
        return self if device is None else replace(self, depth=self.depth.to(device, non_blocking=True))

    @property
    def origin(self) -> Tensor:
        """The position (3,) of the camera, on the device of the image."""
        return self.pose.translation.to(self.depth.device, non_blocking=True)

    def pixels(self) -> Tensor:
        """The pixels (N,) that are not left out, row by row."""
        depth = self.depth
        valid = (depth > 0) & (depth < self.max_range)  # also not NaN, nor infinite
        return valid.flatten().nonzero().squeeze(1)

    def _seen(self, pixels: Tensor) -> Tensor:
        """x/z, y/z and z (3, N) of the points of pixels (N,), in the frame of the camera."""
        fx, fy, cx, cy = self.camera
        row, column = pixels // self.depth.shape[1], pixels % self.depth.shape[1]
        x, y = (column.double() - cx) / fx, (row.double() - cy) / fy
        return torch.stack([x, y, self.depth[row, column].double()])

    def points_at(self, pixels: Tensor) -> Tensor:
        """The points (N, 3) of pixels (N,)."""
        x, y, depth = self._seen(pixels)
        points = torch.stack([x * depth, y * depth, depth], 1)
        return points @ self.pose.rotation.T.to(points.device, non_blocking=True) + self.origin

    @property
    def points(self) -> Tensor:
        """The points (N, 3) of all pixels that are not left out, computed at each access."""
        return self.points_at(self.pixels())

    @property
    def ranges(self) -> Tensor:
        """Distances (N,) of the points from the camera (m), without computing the points."""
        x, y, depth = self._seen(self.pixels())
        return depth * (x.square() + y.square() + 1).sqrt()

    def scan(self) -> Scan:
        """The frame as a scan. Raises `InvalidArgumentError` for points farther away than a map stores."""
        try:
            return Scan(self.points, self.origin)
        except InvalidArgumentError as error:
            raise InvalidArgumentError(f"{self.name} has such points: {error}") from error


def mean_range(window: Sequence[Scan | DepthFrame]) -> float:
    """Mean range (m) of the returns of scans, or of frames. There must be one."""
    frames = [frame for frame in window if isinstance(frame, DepthFrame)]
    sums = None
    if frames:
        camera, reach = ([getattr(frame, name) for frame in frames] for name in ("camera", "max_range"))
        sums = range_sums([frame.depth for frame in frames], np.array(camera), np.array(reach))
    if sums is None:
        found = [
            scan.ranges if isinstance(scan, DepthFrame) else (scan.points - scan.origin).norm(dim=1).double()
            for scan in window
        ]
        return float(torch.cat(found).mean())
    total, n = sums.tolist()
    return total / n


class PooledFrames(NamedTuple):
    """C cells of the points of S frames: mean features (C, 10) about `center` (3,), number of points (C,),
    and points of each frame (C, S)."""

    features: Tensor
    weight: Tensor
    counts: Tensor
    center: Tensor


def pool_frames(frames: Sequence[DepthFrame], finest: float, max_cells: int) -> PooledFrames:
    """The points of frames, summed into at most `max_cells` cubic cells.

    The cells have side `finest` (m). If that gives too many cells, the side grows in steps of a third of an
    octave until the limit holds, which must be 8 or more. Raises `InvalidArgumentError` for points that are
    farther away than a map stores.
    """
    rotation, origin = (np.stack([frame.pose.parts[i].numpy() for frame in frames]) for i in (0, 1))
    camera = np.array([frame.camera for frame in frames])
    fx, fy, cx, cy = camera.T[..., None]
    across, down = rotation[..., 0] / fx, rotation[..., 1] / fy
    first, reference = rotation[..., 2] - cx * across - cy * down, origin[0]
    rays, shortest = np.stack([first, across, down, origin - reference], 1), camera[:, :2].min(1)
    depths, max_range = [frame.depth for frame in frames], np.array([frame.max_range for frame in frames])

    def side_of(thirds: int) -> float:
        return finest * 2 ** (thirds / 3)

    def pooled(thirds: int) -> DepthCells | None:
        side = side_of(thirds)
        return depth_cells(DepthViews(depths, rays / side, 1 / (shortest * side), max_range), side, max_cells)

    first = pooled(0)
    if first is None:
        scans = [frame.scan() for frame in frames]  # raises for points that are too far away
        away = [scan.points - scan.points.new_tensor(reference) for scan in scans if len(scan.points)]
        extent = max(float(offsets.abs().max()) for offsets in away)
        thirds, cells = coarsest_allowed(pooled, 3 * math.ceil(math.log2(extent / finest + 2)))
    else:
        thirds, cells = 0, first
    side = side_of(thirds)
    weight = cells.sums[:, 0].contiguous()
    total = (cells.sums[:, 1:4] + weight[:, None] * cells.corners).sum(0)
    center = total / weight.sum().clamp_min(1)
    features = cell_features(cells, center, side)
    if features is None:
        scale = weight.new_tensor([1.0] + [side] * 3 + [side**2] * 6)
        features = shift_features(cells.sums / weight[:, None], cells.corners - center) * scale
    shift = torch.from_numpy(reference).to(center.device, non_blocking=True)
    return PooledFrames(features, weight, cells.counts, center * side + shift)


def as_scans(window: Iterable[Scan | DepthFrame]) -> list[Scan]:
    """The scans of frames; scans as they are."""
    return [frame.scan() if isinstance(frame, DepthFrame) else frame for frame in window]


def whole_frames(
    frames: Sequence[tuple[ArrayLike, ArrayLike]], broken: dict[int, GmmTorchError], *options: Any
) -> Iterator[DepthFrame]:
    """Frames (depth, pose) that are not broken; `options` as in `DepthFrame.of`, from the intrinsics on.

    `broken` receives the errors of the others, by their index.
    """
    for index in range(len(frames)):
        try:
            frame = frames[index]
            if not isinstance(frame, tuple | list) or len(frame) != 2:
                raise InvalidArgumentError(
                    f"frames[{index}] is a {type(frame).__name__}; give pairs (depth (H, W), pose (4, 4))."
                )
            made = DepthFrame.of(*frame, *options)
        except (InvalidArgumentError, DataError) as error:
            broken[index] = error
        else:
            yield replace(made, name=f"frames[{index}]")


def error_of_some(broken: dict[int, GmmTorchError], n: int) -> GmmTorchError:
    """The error of the broken ones of n frames, of which the others are learned."""
    named, first = ", ".join(f"frames[{index}]" for index in broken), next(iter(broken.values()))
    return type(first)(
        f"{named} {'is' if len(broken) == 1 else 'are'} not learned; the other {n - len(broken)} frames are "
        f"in the map. The first error: {first}"
    )


_FEW_POINTS, _MOST_CELLS = 1_000, 50_000  # fewer points are not pooled; more cells are not worth their time
_WIDEST = 2.0**22  # times the noise: sums of squares of float64 still show the noise
_TOLERANCE = 1e-4  # of EM: relative change of the log-likelihood


@dataclass(frozen=True)
class SurfaceFit:
    """How points become components.

    noise: standard deviation of the range sensor (m); its square is added to every variance.
    cell: side (m) of the cells into which points are summed.
    flatness: when a piece is cut further.
    iterations: largest number of EM iterations.
    max_cells: clouds with more points are summed into cells, at most this many. None: between 1,000 and
        50,000, and fewer than points.
    dtype: type of the exponentials in EM.
    partition_by_moments: cut pieces by the moments of the cells, not only by their means.
    rule: learner and pruning.
    """

    noise: float
    cell: float
    flatness: FlatnessRule
    iterations: int
    max_cells: int | None = None
    dtype: torch.dtype = torch.float32
    partition_by_moments: bool = True
    rule: MixtureRule = field(default_factory=MixtureRule)


def fit_window(scans: Sequence[Scan], fit: SurfaceFit, viewpoints: AssignViewpoints) -> Components:
    """Components of the returns of S scans, then `max_range` components of the ends of no-return beams.

    `fit.rule.free_points` points on each other beam are treated as ends of no-return beams. Components are
    not numbered, and on the CPU.
    """
    origins = torch.stack([scan.origin.double() for scan in scans])
    channels = [scan.attributes for scan in scans]
    returns = fit_points([scan.points for scan in scans], origins, fit, viewpoints, channels)
    ends = [scan.no_return for scan in scans]
    if fit.rule.free_points:
        before = [_points_before(scan, fit.rule.free_points) for scan in scans]
        ends = [torch.cat(pair) for pair in zip(ends, before, strict=True)]
    if not any(map(len, ends)):
        return returns
    empty = fit_points(ends, origins, fit, viewpoints, max_range=True)
    return Components.concatenate([returns, empty])


def fit_points(
    clouds: Sequence[Tensor],
    origins: Tensor,
    fit: SurfaceFit,
    viewpoints: AssignViewpoints,
    attributes: Sequence[Mapping[str, Tensor]] = (),
    *,
    max_range: bool = False,
) -> Components:
    """Components of S clouds of points (N_s, D), each observed from its sensor origin (S, D), in metres.

    `attributes`: the channels of the points of each cloud. `max_range`: the points are ends of no-return
    beams. Components are not numbered, and on the CPU.
    """
    sizes = [cloud.shape[0] for cloud in clouds]
    n_points, dim = sum(sizes), origins.shape[1]
    if n_points == 0:
        return Components.empty(dim)
    points = torch.cat(list(clouds)).double()
    (low, high), widest = points.aminmax(dim=0), _WIDEST * fit.noise
    if not bool((high - low <= widest).all()):  # moments are sums of squares: wider windows lose digits
        places = torch.unique(((points - low) / widest).long(), dim=0, return_inverse=True)[1]
        made = []
        for number in range(int(places.max()) + 1):
            kept = [place == number for place in places.split(sizes)]
            some = [cloud[rows] for cloud, rows in zip(clouds, kept, strict=True)]
            own = [{k: v[rows] for k, v in a.items()} for a, rows in zip(attributes, kept, strict=False)]
            made.append(fit_points(some, origins, fit, viewpoints, own, max_range=max_range))
        return Components.concatenate(made).with_used_origins()
    ends = torch.tensor(sizes).cumsum(0).to(origins.device, non_blocking=True)
    scan = torch.bucketize(torch.arange(n_points, device=ends.device), ends, right=True)
    center = points.mean(0)
    rule = replace(fit.rule, prune="none") if max_range else fit.rule
    sensor = None
    if rule.prune == "density":  # with the spacing of the beams of the largest scan
        from gmmtorch.mixture import measured_sensor

        largest = sizes.index(max(sizes))
        sensor = measured_sensor(clouds[largest], origins[largest])
    window = _Window(points.sub_(center), scan, origins.double() - center, sensor)
    learn = _LEARNERS[rule.learner]
    found, counts, n_learned, cells, owner = learn(window, replace(fit, rule=rule))
    known = None
    if any(attributes):
        channels = of_scans(attributes, sizes)
        if isinstance(rule.reflectivity, IntensityLaw) and INTENSITY in channels:
            white, place = whitening(found.covariances), owner[cells.member]
            seen = gain(rule.reflectivity, window.points - window.origins[scan], white[0][place])
            channels[INTENSITY] = channels[INTENSITY] / seen[:, None]
        known = learned(channels, cells, owner, found.means, found.covariances)
    found = found._replace(means=found.means + center)
    counts, origins, *parts = on_cpu(counts, origins, *found)
    found, known = Parameters(*parts), Attributes() if known is None else known.on_cpu()
    return _components(found, viewpoints(counts, found.weights, n_learned), origins, max_range, known)


def fit_frames(frames: Sequence[DepthFrame], fit: SurfaceFit, viewpoints: AssignViewpoints) -> Components:
    """Components of the points of depth images, each observed from its camera; see `fit_points`.

    The images are summed into cells at once, without a list of their points. Components are not numbered,
    and on the CPU.
    """
    origins = torch.stack([frame.pose.translation for frame in frames]).detach()
    is_wide = np.ptp(origins.numpy(), 0).max() > _WIDEST * fit.noise
    if is_wide or fit.rule.needs_points or sum(frame.depth.numel() for frame in frames) <= _FEW_POINTS:
        return fit_window([frame.scan() for frame in frames], fit, viewpoints)
    cells = pool_frames(frames, fit.cell, fit.max_cells or _MOST_CELLS)
    if cells.weight.shape[0] == 0:
        return Components.empty(3)
    found = _mixture_of(cells.features, cells.weight, 3, fit)
    owner = most_likely_component(cells.features, found)
    counts = cells.counts.new_zeros(found.weights.shape[0], len(frames)).index_add_(0, owner, cells.counts)
    counts, *parts = on_cpu(counts, found.weights, found.means + cells.center, found.covariances)
    found = Parameters(*parts)
    assigned = viewpoints(counts, found.weights, int(counts.numpy().sum()))
    return _components(found, assigned, origins, max_range=False)


def _components(
    found: Parameters,
    assigned: AssignedViewpoints,
    origins: Tensor,
    max_range: bool,
    attributes: Attributes | None = None,
) -> Components:
    """The components that keep a viewpoint; not numbered. All is on the CPU."""
    rows, weights, by, seen, counts = assigned
    ids = np.zeros((len(rows), 2), np.int64)
    ids[:, 1] = UNNUMBERED
    numbers, seen_by, seen_from = as_tensors(ids, by, seen)
    shapes = found.means.numpy()[rows], found.covariances.numpy()[rows]
    means, covariances, support, seen_count = as_tensors(*shapes, weights, counts)
    known = attributes.selected(torch.from_numpy(rows)) if attributes else Attributes()
    flags, viewpoints = torch.from_numpy(np.full(len(rows), max_range)), (seen_by, seen_from, seen_count)
    parts = means, covariances, support, flags, numbers, origins.double()
    return Components(*parts, *viewpoints, attributes=known)


def _points_before(scan: Scan, n: int) -> Tensor:
    """n points (n·N, D) at equal distances on each beam with a return."""
    shares = (torch.arange(n, dtype=torch.float64, device=scan.points.device) + 0.5) / n
    origin = scan.origin.double()
    return (origin + shares[:, None, None] * (scan.points.double() - origin)).flatten(0, 1)


class _Window(NamedTuple):
    """points (N, D) and origins (S, D), relative to the centre of the points; scan (N,) of each point.

    sensor: for pruning by density.
    """

    points: Tensor
    scan: Tensor
    origins: Tensor
    sensor: SensorModel | None

    def pooled(self, fit: SurfaceFit, side: float) -> Cells:
        """The points summed into cells of this side (m)."""
        most = fit.max_cells or min(_MOST_CELLS, max(_FEW_POINTS, len(self.points) - 1))
        return pool_into_cells(self.points, most, side)

    def counts(self, group: Tensor, n_groups: int) -> Tensor:
        """Points (n_groups, S) of each group in each scan; group (N,) of each point."""
        n_scans = self.origins.shape[0]
        pair = group * n_scans + self.scan
        counts = torch.zeros(n_groups * n_scans, dtype=torch.float64, device=pair.device)
        return counts.index_add_(0, pair, counts.new_ones(1).expand(len(pair))).view(-1, n_scans)


_Learned = tuple[Parameters, Tensor, float, Cells, Tensor]
"""A mixture; its points in each scan (K, S), of which each belongs to its most likely component; the number
of points that pruning leaves; the cells of the points; and their component (C,), −1 if it is pruned."""


def _from_flat_pieces(window: _Window, fit: SurfaceFit) -> _Learned:
    """EM on cells from flat pieces; pruned components lose their points."""
    cells = window.pooled(fit, fit.cell)
    mixture = _mixture_of(cells.features, cells.weight, window.points.shape[1], fit)
    owner = most_likely_component(cells.features, mixture)
    counts = window.counts(owner[cells.member], mixture.weights.shape[0])
    n_points, rule = len(window.points), fit.rule
    if rule.prune == "none":
        return mixture, counts, n_points, cells, owner
    support = mixture.weights * n_points
    if window.sensor is None:
        kept = support >= rule.min_support
    else:
        from gmmtorch.mixture import density_share

        share = density_share(support, mixture, window.sensor, window.origins, counts)
        kept = share >= rule.min_density_share
    weights = mixture.weights[kept]
    left = Parameters(weights / weights.sum(), mixture.means[kept], mixture.covariances[kept])
    number = torch.where(kept, kept.cumsum(0) - 1, -1)
    return left, counts[kept], float(support[kept].sum()), cells, number[owner]


def _from_tree(window: _Window, fit: SurfaceFit) -> _Learned:
    """The leaves of a tree over cells; the points of pruned children go to their siblings."""
    # Loaded here, because they load scikit-learn, which a replica does not need.
    from gmmtorch.mixture import DensityLimit, HierarchicalGaussianMixture, grow

    rule, flatness = fit.rule, fit.flatness
    cells = window.pooled(fit, fit.noise)  # a tree uses the means of cells only
    thickness = flatness.thickness if rule.planarity is None else 0.0
    tree = HierarchicalGaussianMixture(
        flatness.max_components,
        reg_covar=fit.noise**2,
        planarity_threshold=rule.planarity or 0.0,
        thickness=thickness,
        min_support=rule.min_support if rule.prune == "support" else flatness.min_weight,
    )
    limit = None
    if window.sensor is not None:
        seen = window.counts(cells.member, cells.weight.shape[0])
        limit = DensityLimit(rule.min_density_share, window.sensor, window.origins, seen)
    means = cells.features[:, 1 : 1 + window.points.shape[1]].contiguous()
    grown, _, _ = grow(means, cells.weight, tree, density=limit)
    leaves = grown.leaves()
    mixture = Parameters(grown.weights[leaves], grown.means[leaves], grown.covariances[leaves])
    owner = most_likely_component(cells.features, mixture)
    counts = window.counts(owner[cells.member], len(leaves))
    return mixture, counts, len(window.points), cells, owner


_LEARNERS: dict[str, Callable[[_Window, SurfaceFit], _Learned]] = {
    "flat_pieces": _from_flat_pieces,
    "hierarchical": _from_tree,
}


def _mixture_of(features: Tensor, weight: Tensor, dim: int, fit: SurfaceFit) -> Parameters:
    """The mixture of cells with mean features (N, F) and weights (N,), by EM from flat pieces."""
    means = features[:, 1 : 1 + dim].contiguous()
    moments = (features,) if fit.partition_by_moments else ()
    pieces = partition(means, weight, fit.flatness, *moments)
    smallest_variance = fit.noise**2
    first = maximization(pool(features, weight, pieces.labels, pieces.n_pieces), smallest_variance)
    if not fit.iterations:
        return first
    step = em_step(Rows(features, weight, are_points=False), smallest_variance, fit.dtype)
    return run_em(step, first, tol=_TOLERANCE, max_iter=fit.iterations).parameters
