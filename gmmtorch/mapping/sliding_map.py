"""SlidingVoxelMap: hits and misses of the cells around a robot, in a circular buffer (thesis 4.1)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError, check_whole
from gmmtorch.mapping.learning.rules import NoveltyRule
from gmmtorch.occupancy.evidence import bernoulli_entropy, occupancy_probability
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.occupancy.voxels.boxes import Box, flat_index, intersection, to_lattice
from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence
from gmmtorch.occupancy.voxels.ray_casting import rays_in_box

Slices = tuple[slice, ...]


class SlidingVoxelMap:
    """A window of the world's lattice that follows the robot, in constant memory.

    Cell c of the lattice is kept at c modulo the window's shape, so that nothing is copied when the
    window moves: the places of the cells that it leaves are those of the cells that it uncovers.
    Counts are float32: exact up to 2²⁴ rays a cell.

    Args:
        resolution: side (m) of the cells.
        shape: cells of the window along each axis.
        step: the window moves by multiples of so many cells, so that coarser blocks of cells stay the
            same ones, and the robot stays less than a step off the middle.

    Raises `InvalidArgumentError` for a resolution that is not above zero, sides that are not whole
    numbers of cells, or a step of more than half the smallest of them.
    """

    def __init__(
        self,
        resolution: float,
        shape: tuple[int, int, int] = (96, 96, 40),
        step: int = 8,
        device: torch.device | str | None = None,
    ) -> None:
        self.resolution = check_resolution(resolution)
        if len(shape) != 3:
            raise InvalidArgumentError(f"shape={shape} must have 3 sides.")
        self.shape = tuple(check_whole("shape", n, 2) for n in shape)
        self.step = check_whole("step", step, 1)
        if 2 * step > min(shape):
            raise InvalidArgumentError(
                f"step={step} must be at most half the smallest side of shape={shape}."
            )
        self._counts = torch.zeros(2, *self.shape, device=device)
        self._low: list[int] | None = None
        self._rows: list[
            Tensor
        ] = []  # by axis: the part of a cell's storage index, by its place in the window

    # -- where it is ------------------------------------------------------------------------------

    @property
    def low(self) -> Tensor:
        """Lowest cell (3,) int64 of the window."""
        return torch.tensor(self._lowest(), device=self._counts.device)

    @property
    def box(self) -> Box:
        low = self.low
        return Box(low, low + torch.tensor(self.shape, device=low.device))

    def center_on(self, position: Tensor) -> list[Box]:
        """Follow the robot at (3,), metres: along each axis on which it is a step or more off the middle.

        Returns the boxes, disjoint and now empty, of the cells that were not in the window before: all
        of it at first, and after a jump that leaves nothing of the old one.
        """
        cell = to_lattice(position, self.resolution, "position").floor().long().tolist()
        if self._low is None:
            half_step = self.step // 2
            self._place(
                [
                    (c - n // 2 + half_step) // self.step * self.step
                    for c, n in zip(cell, self.shape, strict=True)
                ]
            )
            return [self.box]
        old = self.box
        off = [c - low - n // 2 for c, low, n in zip(cell, self._low, self.shape, strict=True)]
        moves = [abs(o) // self.step * self.step * (1 if o > 0 else -1) for o in off]
        if not any(moves):
            return []
        self._place([low + move for low, move in zip(self._low, moves, strict=True)])
        uncovered = _difference(self.box, old)
        for box in uncovered:
            for stored, _ in self._pieces(box):
                self._counts[(slice(None), *stored)] = 0
        return uncovered

    # -- evidence ---------------------------------------------------------------------------------

    def clear(self) -> None:
        """Forget all evidence; the window stays where it is."""
        self._counts.zero_()

    def add(self, evidence: CellEvidence) -> None:
        """Add evidence; that of cells outside the window is left out."""
        local = evidence.cells - self.low
        _, inside = flat_index(local, self.shape)
        more = [evidence.hits, evidence.misses]
        if not bool(inside.all()):
            kept = inside.nonzero().squeeze(1)
            local, more = local[kept], [part[kept] for part in more]
        index = self._rows[0][local[:, 0]] + self._rows[1][local[:, 1]] + self._rows[2][local[:, 2]]
        for counts, part in zip(self._counts, more, strict=True):
            counts.view(-1).index_add_(0, index, part.float())

    def add_dense(self, box: Box, hits: Tensor, misses: Tensor) -> None:
        """Add hits and misses (nx, ny, nz) of a box; what lies outside the window is left out."""
        if not hits.shape == misses.shape == box.shape:
            raise InvalidArgumentError(
                f"hits {tuple(hits.shape)} and misses {tuple(misses.shape)} must both be of box {box.shape}."
            )
        for stored, local in self._pieces(box):
            self._counts[0][stored] += hits[local]
            self._counts[1][stored] += misses[local]

    def evidence(self, box: Box | None = None) -> tuple[Tensor, Tensor]:
        """Hits and misses (nx, ny, nz), float32, of the window in the order of the lattice, or of a box
        within it: a copy."""
        box = self.box if box is None else box
        if bool((box.low < self.low).any() | (box.high > self.box.high).any()):
            raise InvalidArgumentError(
                f"box from {box.low.tolist()} to {box.high.tolist()} reaches out of the window, which goes "
                f"from {self.low.tolist()} to {self.box.high.tolist()}."
            )
        hits, misses = self._read(box)
        return hits, misses

    def around(self, position: Tensor, shape: tuple[int, int, int], step: int = 8) -> Box:
        """The box of `shape` cells within the window that has a place (3,), metres, nearest its middle, of
        those that begin at multiples of `step` cells from the lowest of the window.

        Raises `InvalidArgumentError` if the window is smaller.
        """
        size = torch.tensor(shape, device=self._counts.device)
        spare = torch.tensor(self.shape, device=size.device) - size
        if bool((spare < 0).any()):
            raise InvalidArgumentError(f"shape={tuple(shape)} is more than the window's {self.shape} cells.")
        cell = to_lattice(position, self.resolution, "position").floor().long() - self.low
        steps = (2 * cell - size + step) // (2 * step)  # rounded
        low = self.low + torch.minimum(steps.clamp_min(0), spare // step) * step
        return Box(low, low + size)

    def beam_novelty(
        self,
        origin: Tensor,
        ends: Tensor,
        is_hit: Tensor,
        rule: NoveltyRule,
        short: float = 0.0,
        within: Box | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Bits (N,) float64 that each beam would take off the window's entropy, and whether it crosses a
        cell that was not observed, (N,) bool (thesis 4.1.2). The cell that a hit ends in was observed only
        if hits were: a rail in a cell that most rays pass by is news to a map that calls the cell free.

        Σ h(p) − h(p′) over the cells that a beam passes through, and ends in if it is a hit: p is the
        occupancy, p′ that with this beam's own miss or hit added. Cells outside the window do not
        count. A reduction may be negative: of a beam that contradicts the map.

        Args:
            origin: (3,), metres. ends: (N, 3). is_hit: (N,) bool, False for beams that met no surface.
            rule: its prior, and from how many rays on a cell counts as observed.
            short: metres before its end over which a beam is not asked about free space, as maps may not
                speak of it that close to surfaces.
            within: cells that count at all, where a map takes in no evidence of others; all if not given.
        """
        if not 0 <= short < math.inf:
            raise InvalidArgumentError(f"short={short} must be finite metres, at least zero.")
        stops = to_lattice(ends, self.resolution, "ends")
        starts = to_lattice(origin, self.resolution, "origin").expand_as(stops)
        told = torch.zeros(len(stops), dtype=torch.float64, device=stops.device)
        way = stops - starts
        length = way.norm(dim=1, keepdim=True).clamp_min(torch.finfo(way.dtype).tiny)
        until = stops - way * (short / self.resolution / length).clamp_max(1) if short else None
        box = self.box if within is None else intersection(self.box, within)
        passage = None if box is None else rays_in_box(starts, stops, box, until)
        if passage is None:
            return told, torch.zeros_like(told, dtype=torch.bool)
        # No beam can tell more bits than it crosses cells: one sum holds the bits, and how many cells
        # were unobserved, as multiples of what is more than twice that.
        mark = 2.0 * (sum(self.shape) + 3)
        hits, misses = self._read(passage.window).double()
        table = _told(hits, misses, 0, 1, rule, mark)
        if passage.block is not passage.window:
            table = torch.nn.functional.pad(table, (1,) * 6)
        table = table.view(-1)
        for visit in passage.visits:
            told.index_add_(0, visit.ray, table.index_select(0, visit.voxel))
        flat, inside = flat_index(stops.floor().long() - passage.window.low, passage.window.shape)
        ended = (is_hit & inside).nonzero().squeeze(1)
        flat = flat[ended]
        hits, misses = hits.view(-1)[flat], misses.view(-1)[flat]
        told[ended] += _told(hits, misses, 1, 0, rule, mark)
        told[ended] += mark * ((hits < rule.observed) & (hits + misses >= rule.observed))
        n_unobserved = (told / mark).round()
        return told - n_unobserved * mark, n_unobserved > 0

    # -- checkpoints ------------------------------------------------------------------------------

    def state(self) -> dict[str, Any]:
        """What `restore` needs to answer as now."""
        return {
            "resolution": self.resolution,
            "shape": list(self.shape),
            "low": None if self._low is None else list(self._low),
            "counts": self._counts.clone(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Take the place of the map whose `state` is given; raises `DataError` if it is of another kind."""
        if tuple(state["shape"]) != self.shape or state["resolution"] != self.resolution:
            raise DataError(
                f"The state is of a window of {tuple(state['shape'])} cells of {state['resolution']} m; this "
                f"one has {self.shape} of {self.resolution} m. Restore it into a map made alike."
            )
        self._counts.copy_(state["counts"])
        if state["low"] is None:
            self._low, self._rows = None, []
        else:
            self._place([int(low) for low in state["low"]])

    # -- storage ----------------------------------------------------------------------------------

    def _lowest(self) -> list[int]:
        if self._low is None:
            raise InvalidArgumentError("The sliding map has no place yet: call center_on with the robot's.")
        return self._low

    def _place(self, low: list[int]) -> None:
        _, ny, nz = self.shape
        device = self._counts.device
        self._low = low
        self._rows = [
            (torch.arange(n, device=device) + lowest) % n * stride
            for n, lowest, stride in zip(self.shape, low, (ny * nz, nz, 1), strict=True)
        ]

    def _read(self, box: Box) -> Tensor:
        """Hits and misses (2, nx, ny, nz) of a box within the window: a copy."""
        counts = self._counts.new_empty(2, *box.shape)
        for stored, local in self._pieces(box):
            counts[(slice(None), *local)] = self._counts[(slice(None), *stored)]
        return counts

    def _pieces(self, box: Box) -> Iterator[tuple[Slices, Slices]]:
        """Blocks of the storage that hold what the window has of a box, and which parts of the box."""
        spans = []
        for n, low, begin, stop in zip(
            self.shape, self._lowest(), box.low.tolist(), box.high.tolist(), strict=True
        ):
            first, last = max(low, begin), min(low + n, stop)
            seam = (first // n + 1) * n  # from here on storage begins anew
            cuts = [first, min(seam, last), last]
            spans.append(
                [
                    (slice(a - a // n * n, a - a // n * n + b - a), slice(a - begin, b - begin))
                    for a, b in itertools.pairwise(cuts)
                    if a < b
                ]
            )
        for piece in itertools.product(*spans):
            yield tuple(stored for stored, _ in piece), tuple(local for _, local in piece)


def _told(hits: Tensor, misses: Tensor, hit: int, miss: int, rule: NoveltyRule, mark: float) -> Tensor:
    """Bits that one more hit or miss takes off cells, `mark` added to those that were not observed."""

    def entropy(h: Tensor, m: Tensor) -> Tensor:
        return bernoulli_entropy(occupancy_probability(h, m, rule.prior))

    bits = entropy(hits, misses) - entropy(hits + hit, misses + miss)
    return bits + mark * (hits + misses < rule.observed)


def _difference(box: Box, other: Box) -> list[Box]:
    """What a box has that another lacks, as disjoint boxes."""
    low, high, parts = box.low.tolist(), box.high.tolist(), []
    for axis, (first, last) in enumerate(zip(other.low.tolist(), other.high.tolist(), strict=True)):
        for begin, stop in ((low[axis], min(first, high[axis])), (max(last, low[axis]), high[axis])):
            if begin < stop:
                part = Box(
                    torch.tensor(low, device=box.low.device), torch.tensor(high, device=box.low.device)
                )
                part.low[axis], part.high[axis] = begin, stop
                parts.append(part)
        low[axis], high[axis] = max(low[axis], first), min(high[axis], last)
        if low[axis] >= high[axis]:
            break
    return parts
