"""GaussianMap: a map of Gaussian components that grows scan by scan."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, check_whole
from gmmtorch.files import write_bytes
from gmmtorch.linalg import argsort, check_rigid
from gmmtorch.mapping.codec import map_file as storage
from gmmtorch.mapping.codec.component_batch import quantized, spatial_order
from gmmtorch.mapping.components import Components, sightings_of
from gmmtorch.mapping.learning.incremental import absorb, depth_scan
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule, WindowedRule
from gmmtorch.mapping.learning.windowed import learn_window
from gmmtorch.mapping.query import Answers
from gmmtorch.mapping.query_options import QueryOptions, check_method
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.grid import VoxelGrid, check_resolution
from gmmtorch.occupancy.protocol import check_queries, check_scan
from gmmtorch.scan import ArrayLike, Scan

Learning = WindowedRule | IncrementalRule
_KINDS: dict[type[Learning], str] = {WindowedRule: "windowed", IncrementalRule: "incremental"}

_ROOM_FOR_SETTINGS = 48  # bytes: they may change once the map is built, and within its budget
_LONGEST_WINDOW = 40  # scans that wait for one that says how many are to
_OF_THE_MACHINE = ("memory_limit", "compiled")  # options of answering that a file does not carry
_BUFFERS = tuple(f.name for f in fields(Components))


class GaussianMap(nn.Module):
    """A map that learns components from windows of neighbouring scans, and knows whence each was seen.

    The components are buffers (see `Components` for shapes): means, covariances, support,
    max_range, ids, origins, seen_by, seen_from, seen_count. What a map answers from, and what it
    writes, are these rounded as its file holds them (`components()`), so that a loaded map answers
    as the saved one.

    Args:
        learning: how scans become components. `IncrementalRule` (the default) merges them as it
            goes, under a budget if it is given one; `WindowedRule` adds a mixture of every window, and
            with `window=1, max_origins=1` is the thesis's map.
        window: scans learned from together, in place of the rule's own.
        resolution: side (m) of the cells that queries without a resolution ask about.
        method: form of evidence that queries without a method ask for: "point", in closed form at
            the point itself; "flux" (exact), "cone" (the thesis's) or "monte_carlo" of the cell that
            holds it.
        random_state: seed; the same scans in the same order then give the same map and answers.
        robot: first half of the components' ids.
        codec: how components are written, and so what is answered from: "quantized", some 10 bytes
            each, or "float", every number as it is.
        answering: further options of `QueryOptions`: prior, cutoff, n_samples, …

    Asking a map does not change it: scans of a window that is not full yet are learned from for the
    answer, and again when the window is. What an answer needs is prepared at the first question
    after an insertion: an index of the components, or by `monte_carlo` rays of the whole map (about a
    second for a million). To keep a map in a file use `save`; `state_dict` restores into a map that
    has its components.
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
    suffix = ".safetensors"

    def __init__(
        self,
        learning: Learning | None = None,
        *,
        window: int | None = None,
        resolution: float = 0.1,
        method: str = "point",
        random_state: int = 0,
        robot: int = 0,
        codec: str = "quantized",
        **answering: Any,
    ) -> None:
        super().__init__()
        check_method(method)
        learning = IncrementalRule() if learning is None else learning
        self.learning: Learning = learning if window is None else replace(learning, window=window)
        if codec not in storage.CODECS:
            raise InvalidArgumentError(f"codec={codec!r} is not one of {', '.join(storage.CODECS)}.")
        self.codec = codec
        self.resolution = check_resolution(resolution)
        self.method = method
        self.answering = QueryOptions(random_state=random_state, **answering)
        self.random_state = int(random_state)
        self.robot = check_whole("robot", robot, 0)
        self._pending: list[Scan] = []
        self._n_windows = 0
        self._n_numbered = 0
        self._rounded: Components | None = None
        self._answers: Answers | None = None

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
            options: as for `GaussianMap`; `codec` is "float" unless it is given.
        """
        options = {"codec": "float", **options}
        mean = _tensor(means)
        if mean.ndim != 2 or mean.shape[1] not in (2, 3):
            raise InvalidArgumentError(f"means has shape {tuple(mean.shape)}; expected (K, 2) or (K, 3).")
        k = mean.shape[0]
        weight = _tensor(support)
        if weight.shape != (k,):
            raise InvalidArgumentError(f"support has shape {tuple(weight.shape)}; expected ({k},).")
        flags = torch.zeros(k, dtype=torch.bool) if max_range is None else torch.as_tensor(max_range).bool()
        made = cls(**options)
        ids = torch.stack([torch.full((k,), made.robot), torch.arange(k)], 1)
        sightings = sightings_of(origins, weight.cpu(), mean.shape[1])
        parts = (_tensor(covariances), weight, flags, ids, *sightings)
        # Copies: arrays that are written to again do not change the map.
        components = Components(mean.clone(), *(part.to(mean.device, copy=True) for part in parts)).checked()
        made._set(components)
        made._n_numbered = k
        return made

    @classmethod
    def of(cls, components: Components, **options: Any) -> GaussianMap:
        """A map of components as they are, ids included; `options` as for `from_components`."""
        made = cls(**{"codec": "float", **options})
        made._commit(components.checked())
        return made

    # -- learning ---------------------------------------------------------------------------------

    def insert(self, scan: Scan) -> None:
        """Learn from a scan. It counts at once; the components of its window are final when it is full."""
        check_scan(scan)
        if self.dim is not None and scan.dim != self.dim:
            raise InvalidArgumentError(
                f"scan is {scan.dim}-dimensional, but the map is {self.dim}-dimensional."
            )
        if self.dim is None:
            self._set(Components.empty(scan.dim, scan.points.device))
        self._pending.append(scan.copied(self.means.device))
        self._forget()
        if len(self._pending) >= (self._rule().window or _LONGEST_WINDOW):
            try:
                self._commit(self._with_pending())
            except GmmTorchError:
                self._pending.pop()  # what cannot be learned from is as if it had not been given
                raise

    def insert_depth(
        self,
        frames: Sequence[tuple[Tensor, Tensor]],
        intrinsics: Tensor,
        pixel_stride: int = 4,
        max_range: float = math.inf,
    ) -> None:
        """Learn from depth images, for good: a quick way that only an `IncrementalRule` has.

        Args:
            frames: depth (H, W), metres along the axis, and pose (4, 4), world ← camera, of each.
            intrinsics: (3, 3).
            pixel_stride: every so manieth pixel of every so manieth row stands for those left out.
            max_range: what is at or beyond it is left out, as is what is zero or not finite.
        """
        if not isinstance(self.learning, IncrementalRule):
            raise InvalidArgumentError(
                "insert_depth needs a map with an IncrementalRule; insert scans instead."
            )
        if self.dim not in (None, 3):
            raise InvalidArgumentError(
                f"depth images are 3-dimensional, but the map is {self.dim}-dimensional."
            )
        if not frames:
            return
        if self.dim is None:
            self._set(Components.empty(3, frames[0][0].device))
        if self._pending:
            self._commit(self._with_pending())
        self.learning = self.learning.fitted([depth_scan(*frames[0], intrinsics, pixel_stride, max_range)])
        scans = (depth_scan(*frame, intrinsics, pixel_stride, max_range) for frame in frames)
        learned = absorb(self._committed(), scans, self.learning, self._size, float(pixel_stride**2))
        self._commit(self._numbered(learned))

    def _rule(self) -> Learning:
        """The rule, with what it takes from the first scans."""
        rule = self.learning
        return rule.fitted(self._pending) if isinstance(rule, IncrementalRule) else rule

    def _commit(self, learned: Components) -> None:
        """Keep what was learned, the scans that waited included, for good."""
        self.learning = self._rule()
        self._n_windows += bool(self._pending)
        self._pending = []
        self._set(learned)
        self._n_numbered = self._next_number(learned)

    def _next_number(self, components: Components) -> int:
        """The sequence that the next new component gets after these: none is given twice."""
        return max(self._n_numbered, int(components.ids[:, 1].max()) + 1 if len(components) else 0)

    def _with_pending(self) -> Components:
        """All components, learned from the scans that wait, too."""
        known = self._committed()
        if not self._pending:
            return known
        # A generator of its own for every window: what was asked meanwhile does not matter.
        generator = torch.Generator().manual_seed(hash((self.random_state, self._n_windows)) % 2**63)
        if isinstance(self.learning, IncrementalRule):
            learned = absorb(known, self._pending, self.learning, self._size)
        else:
            learned = Components.concatenate([known, learn_window(self._pending, self.learning, generator)])
        return self._numbered(learned)

    def _numbered(self, learned: Components) -> Components:
        # New ones are numbered, and kept, in an order that takes few bytes.
        fresh = learned.ids[:, 1] < 0
        rank = torch.zeros(len(learned), dtype=torch.int64, device=fresh.device)
        rank[spatial_order(learned)] = torch.arange(len(learned), device=fresh.device)
        learned = learned.rearranged(argsort(torch.where(fresh, len(learned) + rank, 0)))
        numbers = self._n_numbered + torch.arange(int(fresh.sum()), device=fresh.device)
        ids = learned.ids.clone()
        ids[len(ids) - len(numbers) :] = torch.stack([torch.full_like(numbers, self.robot), numbers], 1)
        return replace(learned, ids=ids)

    def _size(self, components: Components) -> int:
        """Bytes of the file of these components, once they are numbered."""
        return len(self._serialized(self._numbered(components))) + _ROOM_FOR_SETTINGS

    def _as_written(self, components: Components) -> Components:
        return components if self.codec == "float" else quantized(components)

    def finish(self) -> None:
        """Learn now from the scans that wait, rather than at the first question. Changes no answer."""
        if self.dim is not None:
            self.components()

    def components(self) -> Components:
        """All components as they are stored, those of the unfinished window included."""
        if self._rounded is None:
            self._rounded = self._as_written(self._with_pending())
        return self._rounded

    def _committed(self) -> Components:
        if self.dim is None:
            raise InvalidArgumentError("The map is empty; insert a scan first.")
        return Components(**{name: getattr(self, name) for name in _BUFFERS})

    def _set(self, components: Components) -> None:
        for name in _BUFFERS:
            self.register_buffer(name, getattr(components, name))
        self._forget()

    def _forget(self) -> None:
        """The components have changed."""
        self._rounded, self._answers = None, None

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> GaussianMap:
        """Moves between devices, waiting scans too; positions stay float64 whatever dtype a network
        around the map takes."""
        super()._apply(lambda tensor: tensor.to(fn(tensor.new_empty(0)).device), recurse)
        if "means" in self._buffers:
            self._pending = [scan.to(self.means.device) for scan in self._pending]
        self._forget()
        return self

    def _load_from_state_dict(self, *args: Any) -> None:
        super()._load_from_state_dict(*args)
        if self.dim is not None:
            self._pending = []
            self._commit(self._committed())

    @property
    def dim(self) -> int | None:
        """2 or 3; None while the map is empty."""
        return self.means.shape[1] if "means" in self._buffers else None

    @property
    def n_components(self) -> int:
        return len(self.components()) if self.dim is not None else 0

    @property
    def n_pending(self) -> int:
        """Scans of the unfinished window; 0: all components are final."""
        return len(self._pending)

    def transform(self, transform: ArrayLike, ids: ArrayLike | None = None) -> None:
        """Move components by a rigid motion (D+1, D+1), and with them the origins they were seen from.

        `ids` (J, 2) names the components, as in the buffer of that name; all if not given. Ids that
        no component has (of records not received, say) are passed over. A pose
        correction is this; nothing is fitted again. Scans of an unfinished window are learned from first.
        """
        components = self._with_pending()
        matrix = _tensor(transform).to(components.means.device)
        check_rigid(matrix, components.dim)
        self._commit(components.transformed(matrix, self._chosen(components, ids)))

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

    def _serialized(self, components: Components) -> bytes:
        facts = {
            "learning": {"kind": _KINDS[type(self.learning)], **changed(self._rule())},
            "resolution": self.resolution,
            "method": self.method,
            "codec": self.codec,
            "robot": self.robot,
            "n_numbered": self._next_number(components),
            **changed(self.answering, leave_out=_OF_THE_MACHINE),
        }
        return storage.to_bytes(components, facts, self.codec)

    @property
    def nbytes(self) -> int:
        """Bytes of the file that `save` writes; 0 for an empty map."""
        return len(self._serialized(self.components())) if self.dim is not None else 0

    def save(self, path: str | Path) -> None:
        """Write the map, atomically. An unfinished window is written as it is fitted now."""
        write_bytes(path, self._serialized(self.components()))

    @classmethod
    def load(cls, path: str | Path) -> GaussianMap:
        """Read a map that `save` wrote; it gives the same answers. Raises `DataError` if it is not one."""
        components, facts = storage.from_file(path)
        try:
            n_numbered = check_whole("n_numbered", facts.pop("n_numbered"), 0)
            made = cls(_read_rule(**facts.pop("learning")), **facts)
        except (TypeError, KeyError, ValueError) as error:
            raise DataError(f"{path}: its settings are damaged ({error}).") from error
        made._set(components)
        made._n_numbered = n_numbered
        made._n_numbered = made._next_number(components)
        return made

    def state(self) -> dict[str, Any]:
        """All that learning goes on from, unrounded, and the scans that wait."""
        return {
            "learning": {"kind": _KINDS[type(self.learning)], **changed(self.learning)},
            "components": None if self.dim is None else dict(vars(self._committed())),
            "pending": [dict(vars(scan)) for scan in self._pending],
            "n_windows": self._n_windows,
            "n_numbered": self._n_numbered,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go on as the map whose `state` is given, with this one's seed and answering.

        Raises `DataError` for a state that is damaged; nothing has changed then.
        """
        try:
            learning = _read_rule(**state["learning"])
            components = None if state["components"] is None else Components(**state["components"]).checked()
            pending = [Scan(**scan) for scan in state["pending"]]
            n_windows = check_whole("n_windows", state["n_windows"], 0)
            n_numbered = check_whole("n_numbered", state["n_numbered"], 0)
        except (GmmTorchError, KeyError, TypeError, ValueError, RuntimeError, AttributeError) as error:
            raise DataError(f"The state of the map is damaged ({error}).") from error
        self.learning, self._pending, self._n_windows = learning, pending, n_windows
        for name in _BUFFERS:
            self._buffers.pop(name, None)
        if components is not None:
            self._set(components)
        self._n_numbered = n_numbered
        self._forget()


def changed(options: Any, leave_out: Sequence[str] = ()) -> dict[str, Any]:
    """The options of a dataclass that are not its defaults."""
    plain = asdict(type(options)())
    return {k: v for k, v in asdict(options).items() if v != plain[k] and k not in leave_out}


def _read_rule(kind: str, novelty: dict[str, Any] | None = None, **options: Any) -> Learning:
    """The rule that a file holds the kind and the changed options of."""
    if novelty is not None:
        options["novelty"] = NoveltyRule(**novelty)
    return {name: rule for rule, name in _KINDS.items()}[kind](**options)


def _tensor(value: ArrayLike) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)  # not by way of float32, as lists would go
