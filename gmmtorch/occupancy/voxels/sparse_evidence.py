"""Sparse stores: the key index that they share, and hits and misses in blocks of cells with evidence."""

from __future__ import annotations

import functools
import math

import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import InvalidArgumentError, MemoryLimitError, check_resolution
from gmmtorch.kernels import (
    BlockKeys,
    BlockTable,
    add_counts,
    cell_index,
    count_in_blocks,
    packed_strides,
    traverse,
)
from gmmtorch.occupancy.evidence import checked_rays, occupancy_probability
from gmmtorch.occupancy.grid import BYTES_PER_CELL, MEMORY_LIMIT
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence, contains, intersection

_NOWHERE = 2.0**62  # a coordinate beyond all keys
_LOCAL_BITS = {2: 4, 3: 3}  # bits of the position of a cell in its block, along each axis


class SparseLattice:
    """Base of the sparse stores: an unbounded lattice of cells, of which some are stored, under sorted keys.

    Cell i is the square or cube [i, i + 1) times the resolution, world frame. A block has 16² cells in 2D
    and 8³ cells in 3D. A key packs the coordinates of a block relative to `anchor`, so that maps far from
    the world's origin work, too. Stored keys are found by binary search.

    Args:
        resolution: side (m) of the cells.
        dim: 2 or 3.
        axis_bits: bits of one block coordinate in a key.
        memory_limit: bytes that the store can take.
    """

    def __init__(
        self,
        resolution: float,
        dim: int,
        axis_bits: int,
        device: torch.device | str | None,
        memory_limit: int,
    ) -> None:
        self.resolution = check_resolution(resolution)
        self.dim = dim
        self.memory_limit = memory_limit
        self.anchor: Tensor | None = None
        """Block (D,), int64, on the CPU, that keys are relative to; None until something is stored."""
        self.keys = torch.empty(0, dtype=torch.int64, device=device)
        """Stored keys (N,), ascending."""
        self._axis_bits = axis_bits
        self._half = 1 << (axis_bits - 1)
        self.local_bits = _LOCAL_BITS[dim]

    @property
    def block_side(self) -> int:
        """Cells of a block along one axis."""
        return 1 << self.local_bits

    @property
    def cells_per_block(self) -> int:
        return 1 << (self.local_bits * self.dim)

    @property
    def device(self) -> torch.device:
        return self.keys.device

    def cells_of(self, points: Tensor) -> Tensor:
        """Cell (M, D), float64, of each point (M, D), world metres."""
        return (points.double() / self.resolution).floor()

    def origin(self) -> Tensor:
        """The anchor, or zero if it is not set: (D,) int64."""
        return torch.zeros(self.dim, dtype=torch.int64) if self.anchor is None else self.anchor

    def columns(self, cells: Tensor) -> list[Tensor]:
        """Coordinates (M,) of cells (M, D) along each axis, relative to the lowest cell of the anchor."""
        low = (self.origin() * self.block_side).tolist()
        return [cells[:, axis] - low[axis] for axis in range(self.dim)]

    def reachable(self, columns: list[Tensor]) -> Tensor:
        """Whether each cell (M,), of `columns` of any dtype, has a key; False for NaN and infinity."""
        limit = (self._half - 1) * self.block_side
        return functools.reduce(torch.logical_and, [column.abs() < limit for column in columns])

    def check_reachable(self, cells: Tensor) -> None:
        """Raise `InvalidArgumentError` unless all cells (M, D) have keys. Sets a missing anchor."""
        if cells.shape[0] and self.anchor is None:
            self.anchor = (cells[0] / self.block_side).floor().long().cpu()
        if not bool(self.reachable(self.columns(cells)).all()):
            reach = (self._half - 1) * self.block_side * self.resolution
            raise InvalidArgumentError(
                f"resolution={self.resolution} m cannot index points more than {reach:.3g} m from the first; "
                "use a coarser one, or remove stray far points."
            )

    def block_keys(self, columns: list[Tensor]) -> Tensor:
        """Keys (M,), int64, of the blocks of the cells of `columns`, in the order of block coordinates."""
        key = (columns[0] >> self.local_bits) + self._half
        for column in columns[1:]:
            key = (key << self._axis_bits) | ((column >> self.local_bits) + self._half)
        return key

    def places(self, columns: list[Tensor]) -> Tensor:
        """Row-major index (M,) of the cells of `columns` within their blocks."""
        mask = self.block_side - 1
        place = columns[0] & mask
        for column in columns[1:]:
            place = (place << self.local_bits) | (column & mask)
        return place

    def cells_at(self, keys: Tensor, places: Tensor) -> Tensor:
        """Cells (M, D) in the blocks with these keys (M,), at these row-major indices (M,) within them."""
        origin, columns = self.origin().tolist(), []
        for axis, shift in enumerate(range(self.dim - 1, -1, -1)):
            block = (keys >> (self._axis_bits * shift)) & ((1 << self._axis_bits) - 1)
            place = (places >> (self.local_bits * shift)) & (self.block_side - 1)
            columns.append(((block - self._half + origin[axis]) << self.local_bits) + place)
        return torch.stack(columns, 1)

    def find_keys(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """Position (M,) of each key in `keys`, and whether it is stored (M,); any position if not."""
        if self.keys.shape[0] == 0:
            return torch.zeros_like(keys), torch.zeros_like(keys, dtype=torch.bool)
        rank = torch.searchsorted(self.keys, keys).clamp_max(self.keys.shape[0] - 1)
        return rank, self.keys[rank] == keys


def count_misses(store: SparseEvidence, origins: Tensor, ends: Tensor, weights: Tensor | None) -> None:
    """Add one miss to each cell that a ray passes through and leaves, and store the blocks of all ends.

    Arguments as in `Evidence.add_rays`. Raises `MemoryLimitError` if the blocks that the rays touch exceed
    the memory limit of the store; the message names a resolution that fits.
    """
    earlier = store.n_blocks
    table = _empty_table(store, origins, ends)
    try:
        block = (store.cells_of(ends).div(store.block_side).floor() - table.low).long()
        index = (block * torch.tensor(packed_strides(table.bits), device=block.device)).sum(1)
        touched = torch.zeros_like(table.first, dtype=torch.bool)
        touched[index] = True
        table.open(touched.nonzero().squeeze(1))
        # In cells of the lattice, not relative to the table: the traversal finds the same cells as a query.
        count_in_blocks(
            lambda: store.counts[1].view(-1),
            table,
            origins.double() / store.resolution,
            ends.double() / store.resolution,
            weights,
        )
    except MemoryLimitError:
        needed = _bytes_needed(store, origins, ends, store.resolution, earlier)
        raise MemoryLimitError(
            f"resolution={store.resolution} m takes {needed:,} bytes for the cells that rays touch, above "
            f"the limit of {store.memory_limit:,}; a resolution of "
            f"{_fitting_resolution(store, origins, ends, earlier):.3g} m fits."
        ) from None


def _empty_table(store: SparseEvidence, origins: Tensor, ends: Tensor) -> BlockTable:
    """The table of the box of blocks that rays can touch. It opens blocks in the store."""
    side = store.block_side
    cells = torch.cat([store.cells_of(origins), store.cells_of(ends)])
    low, high = (corner.div(side).floor() for corner in (cells.amin(0), cells.amax(0)))
    shape = (high - low + 1).long().tolist()
    bits = tuple((n - 1).bit_length() for n in shape)
    n_bytes = 8 << sum(bits)
    if n_bytes > store.memory_limit:
        fits = store.resolution * (n_bytes / store.memory_limit) ** (1 / store.dim) * 1.02
        raise MemoryLimitError(
            f"resolution={store.resolution} m over rays that span {[n * side for n in shape]} cells needs a "
            f"table of {n_bytes:,} bytes, above the limit of {store.memory_limit:,}; a resolution of "
            f"{fits:.3g} m or more fits, or set ‹max_range› to drop stray far returns."
        )
    store.check_reachable(torch.stack([low, high]) * side)
    first = torch.full((1 << sum(bits),), -1, device=low.device)

    def open_blocks(index: Tensor) -> None:
        size = torch.tensor([1 << width for width in bits], device=index.device)
        blocks = index[:, None] // torch.tensor(packed_strides(bits), device=index.device) % size
        cells = (blocks + low.long()) * side
        first[index] = store.open_blocks(store.block_keys(store.columns(cells)))

    return BlockTable(first, low, bits, store.local_bits, open_blocks)


def _bytes_needed(
    store: SparseEvidence, origins: Tensor, ends: Tensor, resolution: float, earlier: int
) -> int:
    """Upper bound of the bytes of the blocks that rays touch at a resolution, and of `earlier` blocks."""
    side = resolution * store.block_side
    starts, stops = origins.double() / side, ends.double() / side
    blocks = torch.cat([starts, stops]).floor()
    low = blocks.amin(0)
    shape = tuple((blocks.amax(0) - low + 1).long().tolist())
    touched = torch.zeros(math.prod(shape), dtype=torch.bool, device=low.device)
    for voxel, _ in traverse(starts, stops, shape, low=low):
        touched[voxel] = True
    # The traversal leaves out the blocks of the ends. Earlier blocks shrink at least in proportion.
    n_ends = torch.unique(stops.floor(), dim=0).shape[0]
    n_earlier = math.ceil(earlier * store.resolution / resolution)
    return (int(touched.sum()) + n_ends + n_earlier) * store.cells_per_block * BYTES_PER_CELL


def _fitting_resolution(store: SparseEvidence, origins: Tensor, ends: Tensor, earlier: int) -> float:
    """A coarser resolution, rounded to three digits, at which the blocks that these rays touch fit."""
    resolution = store.resolution
    while _bytes_needed(store, origins, ends, resolution, earlier) > store.memory_limit:
        resolution = float(f"{resolution * 1.3:.3g}")
    return resolution


_AXIS_BITS = {2: 31, 3: 21}


class SparseEvidence(SparseLattice):
    """Hits and misses of lattice cells. A block of cells is stored when evidence first falls into it.

    Args:
        resolution: side (m) of the cells.
        dim: 2 or 3.
        box: cells that can be stored; evidence outside is ignored. All cells if not given.
        dtype: of the counts. float32 counts rays exactly up to 2²⁴ in a cell.
        memory_limit: bytes that the blocks can take.

    Raises:
        InvalidArgumentError: a resolution that is not above zero, or a box without cells.
        MemoryLimitError: a box with too many cells for one index.
    """

    def __init__(
        self,
        resolution: float,
        dim: int = 3,
        device: torch.device | str | None = None,
        memory_limit: int = MEMORY_LIMIT,
        *,
        box: Box | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        device = box.low.device if device is None and box is not None else device
        super().__init__(resolution, dim, _AXIS_BITS[dim], device, memory_limit)
        self._box = box
        self._bounds: tuple[Tensor | None, Box | None, Tensor | None] = (None, None, None)
        if box is not None:
            self._check_box(box)
        self._slots = torch.empty_like(self.keys)  # of the blocks, in the order of `keys`
        self.counts = torch.zeros(2, 1, self.cells_per_block, dtype=dtype, device=device)
        """Hits and misses (2, slots, cells). Slot 0 stays empty; cells that are not stored read it."""

    def _check_box(self, box: Box) -> None:
        shape = box.shape
        if len(shape) != self.dim or min(shape) < 1:
            raise InvalidArgumentError(
                f"box from {box.low.tolist()} up to {box.high.tolist()} has no cells; high must exceed low."
            )
        if max(shape) >= (self._half - 2) * self.block_side:
            raise MemoryLimitError(
                f"box of {' × '.join(map(str, shape))} cells is too large for one index; use coarser cells "
                f"than resolution={self.resolution} m."
            )
        if self.anchor is None:
            self.anchor = (box.low >> self.local_bits).cpu()

    @property
    def box(self) -> Box:
        """The cells that can be stored; raises `InvalidArgumentError` if they are not limited."""
        if self._box is None:
            raise InvalidArgumentError(
                "No box is set: pass box=, or call center_on with the robot's position first."
            )
        return self._box

    @property
    def n_blocks(self) -> int:
        """Number of stored blocks."""
        return self.keys.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of the stored blocks and their index."""
        return self.n_blocks * (self._block_bytes + 16)

    @property
    def _block_bytes(self) -> int:
        return 2 * self.counts.element_size() * self.cells_per_block

    def add_rays(
        self,
        origins: ArrayLike,
        ends: ArrayLike,
        weights: ArrayLike | None = None,
        is_hit: ArrayLike | None = None,
    ) -> None:
        """Count rays: one hit in the cell of each end, one miss in every other cell that the ray passes.

        Arguments as in `Evidence.add_rays`. Requires a store without a `box`.

        Raises `InvalidArgumentError` for shapes that do not match, and `MemoryLimitError` if the blocks
        exceed `memory_limit` bytes. Then these rays are counted in part, and no more can be added.
        """
        if self._box is not None:
            raise InvalidArgumentError("add_rays needs evidence without a box; use cast_evidence and add.")
        origins, ends, weights, is_hit = checked_rays(origins, ends, weights, is_hit, self.dim, self.device)
        if ends.shape[0] == 0:
            return
        count_misses(self, origins, ends, weights)
        index = self._index_of(self.cells_of(ends).long())
        source = torch.ones_like(index, dtype=torch.float64) if weights is None else weights
        if is_hit is not None:
            index, source = index[is_hit], source[is_hit]
        self.counts[0].view(-1).scatter_add_(0, index, source.to(self.counts.dtype))

    def add(self, evidence: CellEvidence) -> tuple[Tensor, Tensor]:
        """Add the evidence of distinct cells; return the hits (C,) and misses (C,) before the addition.

        Cells outside the box are ignored, and have 0 before.
        """
        self._check_cells(evidence.cells)
        index = self._index_of(evidence.cells)
        if len(index) and bool(index.min() < 0):
            missing = (index < 0).nonzero().squeeze(1)
            cells = evidence.cells.index_select(0, missing)
            # Neighbouring cells mostly share a block.
            self._allocate(self.block_keys(self.columns(cells)).unique_consecutive().unique())
            index[missing] = self._index_of(cells)
        # Index 0, of cells outside, is in the empty block, which stays empty.
        return add_counts(self.counts, index, evidence.hits, evidence.misses)

    def add_from(self, other: SparseEvidence, box: Box) -> None:
        """Add the evidence that another store has in a box; cells outside the box of this store are ignored.

        Raises `InvalidArgumentError` for a store of another resolution.
        """
        if other.resolution != self.resolution:
            raise InvalidArgumentError(
                f"other has cells of {other.resolution} m, but this store has {self.resolution} m; "
                "they must be equal."
            )
        common = box if self._box is None else intersection(box, self._box)
        if common is None:
            return
        corner = other._corners()
        meets = _meets(corner, self.block_side, common)
        counts = other._counts_in(corner[meets], other._slots[meets], common)
        first = self.open_blocks(self.block_keys(self.columns(corner[meets])))
        self.counts[:, first // self.cells_per_block] += counts

    def _check_cells(self, cells: Tensor) -> None:
        """Raise `InvalidArgumentError` if cells (C, D) have no keys and no box excludes them."""
        if self._box is None:
            self.check_reachable(cells)

    def _index_of(self, cells: Tensor) -> Tensor:
        """Flat index (C,) of cells (C, D) in the counts; −1 in blocks not stored, 0 outside the box."""
        anchor, box, bounds = self._bounds
        if bounds is None or anchor is not self.anchor or box is not self._box:
            low, reach = self.origin() * self.block_side, (self._half - 1) * self.block_side
            ends = (low - reach, low + reach) if self._box is None else self._box
            bounds = torch.stack([part.to(self.device) for part in (low, *ends)])
            self._bounds = self.anchor, self._box, bounds
        keys = BlockKeys(self.keys, self._slots, bounds, self.local_bits, self._axis_bits)
        return cell_index(cells, keys)

    def _first_of(self, keys: Tensor) -> Tensor:
        """Flat index (M,) of the first cell of each block; 0 for blocks that are not stored."""
        if self.n_blocks == 0:
            return torch.zeros_like(keys)
        rank, known = self.find_keys(keys)
        return torch.where(known, self._slots[rank] * self.cells_per_block, 0)

    def open_blocks(self, keys: Tensor) -> Tensor:
        """Store the blocks with these distinct keys (M,); return the flat index (M,) of their first cells.

        Raises `MemoryLimitError` if the blocks exceed `memory_limit` bytes.
        """
        new = keys[~self.find_keys(keys)[1]]
        if new.numel():
            self._allocate(new)
        return self._first_of(keys)

    def _allocate(self, new: Tensor) -> None:
        """Store blocks with distinct keys (M,), of which none is stored."""
        n_blocks = self.n_blocks + new.numel()
        n_bytes = n_blocks * self._block_bytes
        if n_bytes > self.memory_limit:
            raise MemoryLimitError(
                f"resolution={self.resolution} m takes {n_bytes:,} bytes for the observed cells, above the "
                f"limit of {self.memory_limit:,}; use coarser cells."
            )
        capacity = self.counts.shape[1] - 1
        if n_blocks > capacity:
            # Grow by half, so that many small additions stay cheap.
            capacity = max(n_blocks, min(capacity * 3 // 2, self.memory_limit // self._block_bytes))
            grown = self.counts.new_zeros(2, capacity + 1, self.cells_per_block)
            grown[:, : self.n_blocks + 1] = self.counts[:, : self.n_blocks + 1]
            self.counts = grown
        slots = torch.arange(self.n_blocks + 1, n_blocks + 1, device=new.device)
        self.keys, order = torch.sort(torch.cat([self.keys, new]))
        self._slots = torch.cat([self._slots, slots])[order]

    def clear(self) -> None:
        """Remove all evidence; the box stays."""
        self.keys, self._slots = self.keys[:0], self._slots[:0]
        self.counts = self.counts.new_zeros(2, 1, self.cells_per_block)

    def crop(self, box: Box) -> None:
        """Remove the evidence outside `box`, and store only cells in it from now on."""
        self._check_box(box)
        self.check_reachable(torch.stack([box.low, box.high]))
        self._box = box
        corner = self._corners()
        kept = _meets(corner, self.block_side, box)
        self.keys = self.keys[kept]
        # The blocks are copied in the order of their keys, behind the empty one.
        counts = self._counts_in(corner[kept], self._slots[kept], box)
        self.counts = torch.cat([self.counts[:, :1], counts], 1)
        self._slots = torch.arange(1, self.n_blocks + 1, device=self.device)

    def _counts_in(self, corner: Tensor, slots: Tensor, box: Box) -> Tensor:
        """A copy (2, b, cells) of the counts in blocks with these lowest cells (b, D) and slots (b,); 0 for
        cells outside a box."""
        counts = self.counts[:, slots]
        cut = ((corner < box.low) | (corner + self.block_side > box.high)).any(1).nonzero().squeeze(1)
        if len(cut):
            places = torch.arange(self.cells_per_block, device=self.device)
            offsets = [
                (places >> (self.local_bits * shift)) & (self.block_side - 1) for shift in range(self.dim)
            ]
            cells = corner[cut][:, None] + torch.stack(offsets[::-1], 1)
            counts[:, cut] *= contains(box, cells.flatten(0, 1)).view(len(cut), -1)
        return counts

    def _corners(self) -> Tensor:
        """Lowest cell (B, D) of each block, in the order of `keys`."""
        return self.cells_at(self.keys, torch.zeros_like(self.keys))

    def at_points(self, points: ArrayLike) -> tuple[Tensor, Tensor]:
        """Hits (M,) and misses (M,) of the cells that contain points (M, D), world metres.

        They are 0 without evidence, also at points that are NaN or infinite.
        """
        cells = self.cells_of(as_tensor(points, "points", device=self.device))
        reachable = self.reachable(self.columns(cells))
        return self.at_cells(torch.where(reachable[:, None], cells, _NOWHERE).long())

    def at_cells(self, cells: Tensor) -> tuple[Tensor, Tensor]:
        """Hits (C,) and misses (C,) of cells (C, D), int64; 0 without evidence."""
        index = self._index_of(cells).clamp_min_(0)
        hits, misses = (counts.view(-1).index_select(0, index) for counts in self.counts)
        return hits, misses

    def lookup(self, points: ArrayLike, prior: float = 1.0) -> Tensor:
        """Occupancy (M,) of the cells that contain points (M, D), world metres; ½ without evidence."""
        return occupancy_probability(*self.at_points(points), prior)

    def dense(self, box: Box) -> tuple[Tensor, Tensor]:
        """Hits and misses of all cells of a box, in its shape; 0 without evidence."""
        shape = [max(0, n) for n in box.shape]
        if min(shape) == 0:
            hits, misses = self.counts.new_zeros(2, *shape)
            return hits, misses
        side, dim = self.block_side, self.dim
        first, last = box.low >> self.local_bits, box.high - 1 >> self.local_bits
        ends = zip(first.tolist(), last.tolist(), strict=True)
        axes = [torch.arange(a, b + 1, device=self.device) for a, b in ends]
        corners = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).view(-1, dim) << self.local_bits
        columns = self.columns(corners)
        keys = torch.where(self.reachable(columns), self.block_keys(columns), -1)
        slots = self._first_of(keys) // self.cells_per_block
        counts = self.counts.index_select(1, slots).view(2, *map(len, axes), *[side] * dim)
        interleaved = [axis for a in range(1, dim + 1) for axis in (a, a + dim)]
        counts = counts.permute(0, *interleaved).reshape(2, *(side * len(axis) for axis in axes))
        offset = (box.low & (side - 1)).tolist()
        part = tuple(slice(a, a + n) for a, n in zip(offset, shape, strict=True))
        hits, misses = counts[(slice(None), *part)].contiguous()
        return hits, misses

    def cells(self) -> CellEvidence:
        """All cells with evidence, in the order of `keys`; counts in the dtype of the store."""
        hits, misses = (counts.index_select(0, self._slots).view(-1) for counts in self.counts)
        flat = ((hits != 0) | (misses != 0)).nonzero().squeeze(1)
        cells = self.cells_at(self.keys[flat >> (self.local_bits * self.dim)], flat)
        return CellEvidence(cells, hits.index_select(0, flat), misses.index_select(0, flat))

    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner (D,) of the stored blocks, world metres."""
        corner = self._corners()
        return corner.amin(0) * self.resolution, (corner.amax(0) + self.block_side) * self.resolution

    def in_key_order(self) -> tuple[Tensor, Tensor]:
        """Hits and misses (B, cells) of all blocks, in the order of `keys`."""
        hits, misses = self.counts[:, self._slots]
        return hits, misses

    def fill(self, anchor: Tensor, keys: Tensor, observed: Tensor, hits: Tensor, misses: Tensor) -> None:
        """Set the cells `observed` (B, cells) of an empty store; blocks in the order of `keys`."""
        self.anchor = anchor.cpu()
        self.open_blocks(keys)
        slot, place = observed.nonzero(as_tuple=True)
        self.counts[0, slot + 1, place] = hits
        self.counts[1, slot + 1, place] = misses


def _meets(corner: Tensor, side: int, box: Box) -> Tensor:
    """Whether each block (B,) of `side` cells, with lowest cell `corner` (B, D), has cells in a box."""
    return ((corner + side > box.low) & (corner < box.high)).all(1)
