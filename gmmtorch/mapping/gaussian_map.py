"""GaussianMap: a map of Gaussian components that grows scan by scan."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.files import write_bytes
from gmmtorch.linalg import check_rigid
from gmmtorch.mapping import storage
from gmmtorch.mapping.answers import Answering, Answers, check_method
from gmmtorch.mapping.components import Components, sightings_of
from gmmtorch.mapping.learning import LearningRule, learn_window
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.grid import VoxelGrid, check_resolution
from gmmtorch.occupancy.protocol import check_queries, check_scan
from gmmtorch.scan import ArrayLike, Scan

_OF_THE_MACHINE = ("memory_limit", "compiled")  # options of answering that a file does not carry
_BUFFERS = tuple(f.name for f in fields(Components))


class GaussianMap(nn.Module):
    """A mixture of every window of `window` neighbouring scans; components know whence they were seen.

    The components are buffers (see `Components` for shapes): means, covariances, support,
    max_range, ids, origins, seen_by, seen_from, seen_count.

    Args:
        window: scans fitted together; 1 with `max_origins=1` is the thesis's map.
        learning: how a window becomes components.
        resolution: side (m) of the cells that queries without a resolution ask about.
        method: form of evidence that queries without a method ask for: "point", in closed form at
            the point itself; "flux" (exact), "cone" (the thesis's) or "monte_carlo" of the cell that
            holds it.
        random_state: seed; the same scans in the same order then give the same map and answers.
        robot: first half of the components' ids.
        answering: further options of `Answering`: prior, cutoff, n_samples, …

    Asking a map does not change it: scans of a window that is not full yet are fitted for the
    answer, and again when the window is. The first question by `monte_carlo` after an insertion
    casts rays of the whole map (about a second for a million).
    To keep a map in a file use `save`; `state_dict` restores into a map that has its components.
    """

    means: Tensor
    covariances: Tensor
    support: Tensor
    max_range: Tensor
    ids: Tensor
    origins: Tensor
    seen_by: Tensor
    seen_from: Tensor
    seen_count: Tensor

    any_resolution = True

    def __init__(
        self,
        window: int = 20,
        learning: LearningRule | None = None,
        *,
        resolution: float = 0.1,
        method: str = "point",
        random_state: int = 0,
        robot: int = 0,
        **answering: Any,
    ) -> None:
        super().__init__()
        check_whole("window", window, 1)
        check_method(method)
        self.window = window
        self.learning = learning or LearningRule()
        self.resolution = check_resolution(resolution)
        self.method = method
        self.answering = Answering(random_state=random_state, **answering)
        self.random_state = int(random_state)
        self.robot = robot
        self.frame: Tensor | None = None  # (D,) whole metres, near the first scan
        self._pending: list[Scan] = []
        self._n_windows = 0
        self._answers: Answers | None = None
        self._provisional: Components | None = None

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
            means (K, D), covariances (K, D, D), support (K,): the components; metres, points.
            origins: (K, D), one sensor position each; or for each component a list of
                (origin (D,), count), whose counts are scaled to add up to its support.
            max_range: (K,) True for components of beams without return; none if not given.
            options: as for `GaussianMap`.
        """
        mean = _tensor(means)
        if mean.ndim != 2 or mean.shape[1] not in (2, 3):
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, 2) or (K, 3).")
        k = mean.shape[0]
        weight = _tensor(support)
        if weight.shape != (k,):
            raise InvalidArgumentError(f"support has shape {tuple(weight.shape)}; expected ({k},).")
        flags = torch.zeros(k, dtype=torch.bool) if max_range is None else torch.as_tensor(max_range).bool()
        robot = int(options.get("robot", 0))
        ids = torch.stack([torch.full((k,), robot), torch.arange(k)], 1)
        sightings = sightings_of(origins, weight.cpu(), mean.shape[1])
        parts = (_tensor(covariances), weight, flags, ids, *sightings)
        components = Components(mean, *(part.to(mean.device) for part in parts)).checked()
        made = cls(**options)
        made._place(components)
        return made

    # -- learning ---------------------------------------------------------------------------------

    def insert(self, scan: Scan) -> None:
        """Learn from a scan. It counts at once; the components of its window are final when it is full."""
        check_scan(scan)
        if self.dim is not None and scan.dim != self.dim:
            raise InvalidArgumentError(
                f"scan is {scan.dim}-dimensional, but the map is {self.dim}-dimensional."
            )
        if self.frame is None:
            self.frame = scan.origin.detach().double().round()
            self._set(Components.empty(scan.dim, scan.points.device))
        self._pending.append(scan.copied(self.means.device))
        self._forget_answers()
        if len(self._pending) == self.window:
            self._set(Components.concatenate([self._committed(), self._learn_pending()]))
            self._pending = []
            self._n_windows += 1

    def _learn_pending(self) -> Components:
        frame = cast(Tensor, self.frame)
        # A generator of its own for every window: what was asked meanwhile does not matter.
        generator = torch.Generator().manual_seed(hash((self.random_state, self._n_windows)) % 2**63)
        found = storage.storable(learn_window(self._pending, self.learning, generator), frame)
        first = int(self.ids[:, 1].max()) + 1 if len(self.ids) else 0
        sequence = torch.arange(first, first + len(found), device=found.ids.device)
        return replace(found, ids=torch.stack([torch.full_like(sequence, self.robot), sequence], 1))

    def finish(self) -> None:
        """Fit the scans that wait now, rather than at the first question. Changes no answer."""
        if self.dim is not None:
            self.components()

    def components(self) -> Components:
        """All components, those of the unfinished window included."""
        if not self._pending:
            return self._committed()
        if self._provisional is None:
            self._provisional = Components.concatenate([self._committed(), self._learn_pending()])
        return self._provisional

    def _committed(self) -> Components:
        if "means" not in self._buffers:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        return Components(**{name: getattr(self, name) for name in _BUFFERS})

    def _set(self, components: Components) -> None:
        for name in _BUFFERS:
            self.register_buffer(name, getattr(components, name))
        self._forget_answers()

    def _place(self, components: Components) -> None:
        """Take over components, rounded as they are stored, about a frame near their origins."""
        center = components.origins if len(components.origins) else components.means
        self.frame = center.median(0).values.round() if len(center) else center.new_zeros(components.dim)
        self._set(storage.storable(components, self.frame))

    def _forget_answers(self) -> None:
        self._answers, self._provisional = None, None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GaussianMap:
        """Moves between devices, waiting scans too; positions stay float64 whatever dtype a network
        around the map takes."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        if "means" in self._buffers:
            self._pending = [scan.to(self.means.device) for scan in self._pending]
            self.frame = cast(Tensor, self.frame).to(self.means.device)
        self._forget_answers()
        return self

    @property
    def dim(self) -> int | None:
        """2 or 3; None while the map is empty."""
        return None if self.frame is None else self.frame.shape[0]

    @property
    def n_components(self) -> int:
        return len(self.components()) if self.dim is not None else 0

    def transform(self, transform: ArrayLike, ids: ArrayLike | None = None) -> None:
        """Move components by a rigid motion (D+1, D+1), and with them the origins they were seen from.

        `ids` (J, 2) names the components, as in the buffer of that name; all if not given. Ids that
        no component has (of records not received, say) are passed over. A pose
        correction is this; nothing is fitted again. Scans of an unfinished window are fitted first.
        """
        components = self.components()
        matrix = _tensor(transform).to(components.means.device)
        check_rigid(matrix, components.dim)
        moved = components.transformed(matrix, self._chosen(components, ids))
        if self._pending:
            self._pending, self._n_windows = [], self._n_windows + 1
        self._place(moved)

    @staticmethod
    def _chosen(components: Components, ids: ArrayLike | None) -> Tensor:
        """Which components (K,) have one of the ids (J, 2); all if none are given."""
        if ids is None:
            return torch.ones_like(components.max_range)
        wanted = torch.as_tensor(ids).to(components.ids)
        wanted = wanted if wanted.numel() else wanted.reshape(0, 2)
        if wanted.ndim != 2 or wanted.shape[1] != 2:
            raise InvalidArgumentError(
                f"ids has shape {tuple(wanted.shape)}; expected (J, 2): robot, sequence."
            )
        # One number for each id that occurs, so that pairs are compared in one sorted pass.
        known = len(components)
        _, number = torch.unique(torch.cat([components.ids, wanted]), dim=0, return_inverse=True)
        return torch.isin(number[:known], number[known:])

    # -- answering --------------------------------------------------------------------------------

    def occupancy(
        self, points: ArrayLike, resolution: float | None = None, method: str | None = None
    ) -> Tensor | np.ndarray:
        """Probability (M,) that a cube of side `resolution` (m) at each point (M, D) is occupied.

        Of the cube centred at the point by method "point"; of the cell of the lattice that holds the
        point by the others. Exactly ½ where no evidence is, and everywhere while the map is empty.
        Arrays in, arrays out; gradients flow to points that ask for them, by "point".
        """
        query = check_queries(points, self.dim)
        method = self.method if method is None else method
        check_method(method)
        resolution = self.resolution if resolution is None else check_resolution(resolution)
        if self.dim is None:
            theta = torch.full((query.shape[0],), 0.5, dtype=torch.float64, device=query.device)
        else:
            theta = self._answering().occupancy(query.to(self.means.device), resolution, method)
        return theta.to(query.device) if isinstance(points, Tensor) else theta.cpu().numpy()

    def evidence(self, grid: VoxelGrid, method: str | None = None) -> Evidence:
        """Hits and misses of every cell of a grid."""
        method = self.method if method is None else method
        check_method(method)
        if self.dim is None:
            return Evidence.empty(grid)
        if grid.dim != self.dim:
            raise InvalidArgumentError(
                f"grid is {grid.dim}-dimensional, but the map is {self.dim}-dimensional."
            )
        return self._answering().evidence(grid, method)

    def _answering(self) -> Answers:
        if self._answers is None:
            self._answers = Answers(self.components().cones(), self.answering)
        return self._answers

    # -- keeping ----------------------------------------------------------------------------------

    def _serialized(self) -> bytes:
        facts = {
            "window": self.window,
            "learning": asdict(self.learning),
            "resolution": self.resolution,
            "method": self.method,
            "robot": self.robot,
            **{name: value for name, value in asdict(self.answering).items() if name not in _OF_THE_MACHINE},
        }
        return storage.to_bytes(self.components(), cast(Tensor, self.frame), facts)

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty map."""
        return len(self._serialized()) if self.dim is not None else 0

    def save(self, path: str | Path) -> None:
        """Write the map, atomically. An unfinished window is written as it is fitted now."""
        write_bytes(path, self._serialized())

    @classmethod
    def load(cls, path: str | Path) -> GaussianMap:
        """Read a map that `save` wrote; it gives the same answers. Raises `DataError` if it is not one."""
        components, frame, facts = storage.from_file(path)
        try:
            made = cls(**{**facts, "learning": LearningRule(**facts["learning"])})
        except (TypeError, KeyError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error}).") from error
        made._set(components)
        made.frame = frame
        return made


def _tensor(value: ArrayLike) -> Tensor:
    return torch.as_tensor(value).double()
