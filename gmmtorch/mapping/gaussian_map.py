"""GaussianMap: a map of Gaussian components that grows scan by scan."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import (
    DAMAGED_CONTENT,
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    check_choice,
    check_whole,
)
from gmmtorch.files import write_bytes
from gmmtorch.mapping.attributes.answers import Prediction, predictions
from gmmtorch.mapping.attributes.moments import check_kinds
from gmmtorch.mapping.codec.component_batch import CODECS, MapSettings, map_bytes, read_map
from gmmtorch.mapping.codec.quantization import joined, quantized_after
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.fitting import DepthFrame, error_of_some, whole_frames
from gmmtorch.mapping.learning.rules import IncrementalRule, LearningRule, WindowedRule, read_rule
from gmmtorch.mapping.learning.windows import Doubts
from gmmtorch.mapping.map_state import MapState
from gmmtorch.mapping.query import Block, Query
from gmmtorch.mapping.query_options import QueryOptions, Sampling, check_method
from gmmtorch.occupancy import Calibration, Evidence, VoxelGrid, check_queries, check_resolution, check_scan
from gmmtorch.pose import Pose
from gmmtorch.scan import INTENSITY, Scan, as_time, extent


class GaussianMap(MapState):
    """A map that learns Gaussian components from windows of neighbouring scans.

    The components are attributes: means, covariances and the other fields of `Components`, with those of the
    unfinished window; the `state_dict` has them without. Queries and files use the components as the
    codec rounds them (`components()`), so a loaded map gives the same answers as the saved one.

    Args:
        learning: how scans become components. `IncrementalRule` (the default) merges components, under a
            budget if it has one. `WindowedRule` adds a mixture for every window; with `window=1,
            max_origins=1` it gives the thesis's map.
        window: number of scans that are learned together, instead of the rule's own.
        resolution: side (m) of the cells of queries without a resolution.
        method: form of evidence of queries without a method: "point" (closed form at the point), or of the
            cell that contains the point: "flux" (exact), "cone" (the thesis's) or "monte_carlo" (rays).
        random_state: seed. The same scans in the same order give the same map and the same answers.
        robot: first half of the components' ids.
        codec: rounding of components in files and queries: "quantized", about 8 bytes a component, or
            "float", every number as it is.
        prior: None: probabilities are calibrated: the map predicts each window before it learns from it, see
            `occupancy.calibrator`. A number N_p: they follow from counts, as in the thesis (3.9).
        cutoff: Mahalanobis distance at which a component ends. None: 3 if components have many points (a
            median of at least 50 for each viewpoint), so that tails do not claim unseen space; otherwise 5,
            because few points do not show where a surface ends.
        n_samples: number of rays of method "monte_carlo", drawn from the whole map.
        sampling: sequence of these rays, "sobol", "stratified" or "plain".
        memory_limit: largest number of bytes of the evidence of a grid, and of Monte Carlo evidence.
        compiled: has no effect; fused kernels answer queries.
        calibration: from which the map's own goes on, such as that of another map. None: that of the sensor
            model, for the ranges of the map's beams.

    Queries do not change the map: the scans of an unfinished window are learned for the answer, and learned
    again when the window is full. If they are large, a query learns from them scan by scan, in less time than
    together; a map that was asked since the last scan does so when the next one is inserted. `finish`,
    `components` and `save` learn from them together, and until the next scan queries answer from that. Lists
    of the components near the points that were asked about are kept while the map grows; method "monte_carlo"
    draws its rays anew (about a second for a million). `save` and `load` keep a map with its settings.
    `state_dict` holds everything that learning continues from, and loads into any map.
    """

    any_resolution = True
    suffix = ".safetensors"

    def __init__(
        self,
        learning: LearningRule | None = None,
        *,
        window: int | None = None,
        resolution: float = 0.1,
        method: str = "point",
        random_state: int = 0,
        robot: int = 0,
        codec: str = "quantized",
        prior: float | None = None,
        cutoff: float | None = None,
        n_samples: int = 1_000_000,
        sampling: Sampling = "sobol",
        memory_limit: int = 4 << 30,
        compiled: bool = False,
        calibration: Calibration | None = None,
    ) -> None:
        check_method(method)
        check_choice("codec", codec, CODECS)
        rule = IncrementalRule() if learning is None else learning
        if not isinstance(rule, WindowedRule | IncrementalRule):
            raise InvalidArgumentError(
                f"learning={rule!r} is not a learning rule; give IncrementalRule() or WindowedRule()."
            )
        rule = rule if window is None else replace(rule, window=window)
        query = QueryOptions(
            prior, cutoff, n_samples, sampling, random_state, memory_limit, compiled, calibration
        )
        number = check_whole("robot", robot, 0)
        settings = MapSettings(check_resolution(resolution), method, codec, number, query)
        super().__init__(rule, settings, random_state)

    def __repr__(self) -> str:
        scans = f"{self.n_pending} pending scan{'s' if self.n_pending != 1 else ''}"
        if self.dim is None:
            return f"GaussianMap(empty, {type(self.learning).__name__})"
        if self.n_pending and self._learned is None:
            size = f"{self.n_final} components and {scans} not learned yet in {self.dim}D"
        else:
            known = self.unrounded()
            size = f"{len(known)} components in {self.dim}D{extent(known.means)}, {self.nbytes} bytes"
            size += f", {scans}" if self.n_pending else ""
        return f"GaussianMap({size}, {type(self.learning).__name__}, {self._device})"

    @classmethod
    def from_components(
        cls,
        means: ArrayLike,
        covariances: ArrayLike,
        support: ArrayLike,
        origins: ArrayLike | Sequence[Sequence[tuple[ArrayLike, float]]],
        max_range: ArrayLike | None = None,
        **options: Any,
    ) -> GaussianMap:
        """A map of given components.

        Args:
            means, covariances, support: (K, D), (K, D, D), (K,) of the components; metres, points.
            origins: (K, D), one sensor origin for each component; or for each component a list of
                (origin (D,), count), whose counts are scaled to add up to its support.
            max_range: (K,) True for components of no-return beams. None: no component is.
            options: as for `GaussianMap`; the default `codec` is "float".
        """
        robot = check_whole("robot", options.get("robot", 0), 0)
        return cls.of(Components.given(means, covariances, support, origins, max_range, robot), **options)

    @classmethod
    def of(cls, components: Components, **options: Any) -> GaussianMap:
        """A map of components as they are, with their ids; `options` as for `from_components`."""
        options.setdefault("codec", "float")
        made = cls(**options)
        made._commit(components.checked())
        return made

    def snapshot(self, components: Components | None = None, **options: Any) -> GaussianMap:
        """A map that answers like this one and does not grow with it.

        Args:
            components: others than those of this map.
            options: those that differ; the default `codec` is "float".
        """
        own = {**vars(self.query_options), "resolution": self.resolution, "method": self.method}
        return GaussianMap.of(self.components() if components is None else components, **{**own, **options})

    def insert(self, scan: Scan) -> None:
        """Learns from a scan. Queries use it at once; its components are final when their window is full.

        Raises `InvalidArgumentError`, and keeps the map as it is, if the dimension or the kind of a channel
        is not that of the map.
        """
        check_scan(scan)
        known = (one.attributes for one in self._pending)
        final = (block.components.attributes.channels for block in self._blocks)
        check_kinds([*final, *known, scan.attributes])
        values = scan.attributes.get(INTENSITY)
        if self.learning.reflectivity and values is not None and values.shape[1:] != (1,):
            raise InvalidArgumentError(
                'attributes["intensity"] are labels or have several columns; reflectivity=True needs one '
                "number for each point, in a floating type."
            )
        self._prepare(scan.dim, scan.points.device, "scan is")
        former = self._query if self._is_asked else None
        self._add(scan.copied(self._device))
        if former is not None:  # asked since the scan before: the next query does not wait for this one
            self._answers().prepare(former)
        self._is_asked = False

    def insert_depth(
        self,
        frames: Sequence[tuple[ArrayLike, ArrayLike]],
        intrinsics: ArrayLike,
        pixel_stride: int = 4,
        max_range: float = math.inf,
        depth_scale: float | None = None,
    ) -> None:
        """Learns from depth images at once, without an unfinished window. Needs an `IncrementalRule`.

        Args:
            frames: for each image its depth (H, W), metres along the optical axis, and its pose (4, 4),
                world ← camera.
            intrinsics: (3, 3) pinhole matrix of images of this size, in pixels.
            pixel_stride: uses every `pixel_stride`-th pixel of every `pixel_stride`-th row; each counts for
                `pixel_stride²` points. With 1, every pixel is used.
            max_range: pixels at or beyond it (m) are left out, as are pixels that are zero or not finite.
            depth_scale: metres per unit of the images, such as 0.001 for millimetres. Images of integers need
                it; None: metres, in a floating type.

        A frame without a valid pixel adds nothing. Raises `InvalidArgumentError`, or `DataError` of a file,
        if a frame is broken: no pair, no image, or a pose that is not rigid. If others are whole, they are
        learned before, and the error names the broken ones: frames[7]. A pixel farther away than a map
        stores is an error that keeps the map as it is.
        """
        if not isinstance(self.learning, IncrementalRule):
            raise InvalidArgumentError(
                "insert_depth needs a map with an IncrementalRule; insert scans instead."
            )
        check_whole("pixel_stride", pixel_stride, 1)
        if len(frames) == 0:
            return
        broken: dict[int, GmmTorchError] = {}
        intrinsics = as_tensor(intrinsics, "intrinsics", torch.float64, "cpu")
        whole = whole_frames(frames, broken, intrinsics, pixel_stride, max_range, depth_scale)
        first = next(whole, None)
        if first is None:
            raise broken[0]
        self._prepare(3, first.depth.device, "depth images are")
        if self.n_pending:
            self._commit(*self._upcoming())
        self.learning = self.learning.fitted([first])
        taken = (frame.to(self._device) for frame in itertools.chain([first], whole))
        calibrator, n_windows = self._calibrator, self._n_windows

        def predict(known: Components, window: Sequence[Scan | DepthFrame]) -> None:
            nonlocal calibrator, n_windows
            blocks = [*self._blocks[:-1], Block(known)]
            calibrator = self._predicted(blocks, window, calibrator, n_windows)
            n_windows += 1

        learned = self._absorbed(taken, self.learning, float(pixel_stride**2), predict)
        self._calibrator, self._n_windows = calibrator, n_windows
        self._commit(*learned)
        if broken:
            raise error_of_some(broken, len(frames))

    def finish(self) -> None:
        """Learns from the scans of the unfinished window together, as from those of a full one."""
        if self.dim is not None:
            self._rounded_parts()

    def components(self) -> Components:
        """All components as the codec rounds them, with those of the unfinished window."""
        if self._all_rounded is None:
            parts = self._rounded_parts()
            self._all_rounded = Components.concatenate(parts) if self.codec == "float" else joined(parts)
        return self._all_rounded

    def _rounded_parts(self, pending: bool = True) -> list[Components]:
        """The components of each block as the codec rounds them, the last with those of the unfinished window
        if `pending`."""
        last = self._upcoming()[0] if pending else self._last
        if self.codec == "float":
            return [*self._parts_before, last]
        none = Components.empty(last.dim, last.means.device)
        former = [*self._rounded, *[(none, none)] * len(self._blocks)]
        self._rounded = [
            (final, rounded if known is final else quantized_after(known, rounded, final))
            for block, (known, rounded) in zip(self._blocks, former, strict=False)
            for final in [block.components]
        ]
        *before, final = self._rounded
        return [
            *(rounded for _, rounded in before),
            final[1] if last is final[0] else quantized_after(*final, last),
        ]

    def transform(self, transform: ArrayLike, ids: ArrayLike | None = None) -> None:
        """Moves components and their sensor origins by a rigid motion (D+1, D+1), as a pose correction does.

        `ids` (J, 2): robot and sequence number of the components; None: all. Ids that the map does not
        contain are ignored. Nothing is fitted again. An unfinished window is learned first.
        """

        def moved(components: Components) -> Components:
            pose = Pose.checked(transform, components.dim, device=components.means.device)
            return components.transformed(pose.matrix, components.has_id(ids))

        self.revise(moved)

    def revise(self, change: Callable[[Components], Components]) -> None:
        """Replaces all components by the result of `change` for them, not rounded. An unfinished window is
        learned first."""
        self._commit(change(self.unrounded()))

    @property
    def n_components(self) -> int:
        """Number of components, those of the unfinished window included."""
        return self.n_final + len(self._upcoming()[0]) - len(self._last) if self.dim is not None else 0

    def occupancy(
        self, points: ArrayLike, resolution: float | None = None, method: str | None = None
    ) -> Tensor | np.ndarray:
        """Probability (M,) that a cube of side `resolution` (m) at each point (M, D) is occupied.

        Method "point" takes the cube centred at the point; the others take the cell of the lattice that
        contains the point. Exactly ½ without evidence, and everywhere while the map is empty. Arrays give
        arrays, tensors give tensors. Method "point" is differentiable in the points.
        """
        query = check_queries(points, self.dim)
        method = self.method if method is None else method
        check_method(method)
        resolution = self.resolution if resolution is None else check_resolution(resolution)
        if self.dim is None:
            theta = torch.full((query.shape[0],), 0.5, dtype=torch.float64, device=query.device)
        else:
            theta = self._answers().occupancy(query.to(self._device), resolution, method)
        return theta.to(query.device) if isinstance(points, Tensor) else theta.detach().cpu().numpy()

    def evidence(self, grid: VoxelGrid, method: str | None = None) -> Evidence:
        """Hits and misses of every cell of a grid.

        Raises `MemoryLimitError` if they take more than `memory_limit` bytes, 16 for each cell.
        """
        method = self.method if method is None else method
        check_method(method)
        grid.check_memory(self.query_options.memory_limit)
        if self.dim is None:
            return Evidence.empty(grid)
        if grid.dim != self.dim:
            raise InvalidArgumentError(
                f"grid is {grid.dim}-dimensional, but the map is {self.dim}-dimensional."
            )
        return self._answers().evidence(grid, method)

    def attributes(self, points: ArrayLike, seen_from: ArrayLike | None = None) -> dict[str, Prediction]:
        """Each channel of the map, such as "colour", at points (M, D) in metres; see `Prediction`.

        Unknown where no component is near, and without channels while no scan had any. Differentiable in the
        points; tensors are on their device.

        seen_from: (D,) or (M, D) positions of sensors, whose intensities are predicted instead of the
            reflectivities that a rule with `reflectivity` learns; those of unknown points stay.
        """
        query = check_queries(points, self.dim)
        if self.dim is None:
            return {}
        asked, law, seen = query.to(self._device), self._next_rule.reflectivity, None
        if seen_from is not None:
            if isinstance(law, bool):
                raise InvalidArgumentError(
                    "seen_from needs a map that learned reflectivities from scans with intensity: give it a "
                    "rule such as IncrementalRule(reflectivity=True)."
                )
            sensors = as_tensor(seen_from, "seen_from", torch.float64, self._device)
            if sensors.shape not in (asked.shape[1:], asked.shape) or not bool(sensors.isfinite().all()):
                raise InvalidArgumentError(
                    f"seen_from has shape {tuple(sensors.shape)}, or is not finite; expected one position "
                    f"{tuple(asked.shape[1:])} in metres, or one for each point."
                )
            seen = law, sensors.expand_as(asked)
        found = predictions(self.components(), asked, seen=seen)
        return {name: prediction.to(query.device) for name, prediction in found.items()}

    def _answers(self) -> Query:
        self._is_asked = True
        if self._query is None or self._is_stale:
            parts = self._window_parts()
            self._query = Query(
                self._rounded_parts(parts is None), self.query_options, parts or (), self._query
            )
            self._is_stale = False
        return self._query

    def _file(self, components: Components | None = None) -> bytes:
        """The map's file. `components`: instead of all."""
        found = self.components() if components is None else components
        return map_bytes(found, self._next_rule, self.settings, self._next_number)

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty map."""
        return len(self._file()) if self.dim is not None else 0

    def save(self, path: str | Path) -> None:
        """Writes the map atomically. The scans of an unfinished window are learned for the file."""
        write_bytes(path, self._file())

    @classmethod
    def load(cls, path: str | Path) -> GaussianMap:
        """Reads a map that `save` wrote; it gives the same answers. Raises `DataError` for other files."""
        components, facts = read_map(path)
        try:
            next_number = check_whole("n_numbered", facts.pop("n_numbered"), 0)
            time = as_time(facts.pop("time", None))
            made = cls(read_rule(**facts.pop("learning")), **facts)
        except DAMAGED_CONTENT as error:
            raise DataError(f"{path}: its settings are damaged ({error}).") from error
        made._next_number, made._next_doubts = next_number, Doubts.none(time)
        made._commit(components)
        if not components.attributes:  # rounding again would change nothing
            made._rounded = [(block.components, block.components) for block in made._blocks]
        return made
