"""TiledMap: a map in files of square tiles. A query opens only the tiles that it needs.

A component belongs to the tile that contains its mean. Its evidence reaches into other tiles, because its
rays start at the sensor. The index therefore states for each tile a box outside which its components give
no evidence, and a query opens exactly the tiles whose box contains it. Evidence of components adds up, so
the answers are those of the whole map, up to the rounding of sums.

`tile_files` makes the files from components; `merge` merges the tiles of several recordings.
"""

from __future__ import annotations

import math
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import (
    DataError,
    GmmTorchError,
    InvalidArgumentError,
    MemoryLimitError,
    MissingDataError,
    check_number,
    check_whole,
)
from gmmtorch.files import MAX_FILE_BYTES, pack_tensors, read_tensors, require, write_bytes
from gmmtorch.mapping.codec.component_batch import (
    MapSettings,
    file_size,
    map_bytes,
    read_map_bytes,
    read_settings,
    settings_facts,
)
from gmmtorch.mapping.codec.quantization import quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.merging import compact_to_bytes
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.query import Query, count_many, cutoff_of, evidence_boxes, mean_range, rule_of
from gmmtorch.mapping.query_options import check_method
from gmmtorch.occupancy import (
    CUTOFF,
    Calibration,
    PointEvidence,
    Rule,
    check_queries,
    check_resolution,
    cone_bounds,
    probability,
)
from gmmtorch.scan import FARTHEST

_BYTES_EACH = 4096  # memory of a component that answers queries, most of it in the spatial index
_REMEDY = "copy the folder again from where it was written, or merge the recordings again"


class TiledMap:
    """A map in a folder: one map file for each tile, and an index file.

        tiled = TiledMap("outputs/map/RUN/tiles")
        tiled.occupancy(points)  # opens the tiles that give evidence at the points
        tiled.open(low, high)  # a GaussianMap of the tiles that give evidence in a box

    `tile_files` and `merge` make such folders.

    Args:
        folder: with the index file.
        device: of the evidence.
        most_open: number of tiles that stay in memory between queries.
        memory_limit: bytes of the evidence, and of the components of an opened box, at most.

    Attributes:
        index: see `TileIndex`. dim: 2 or 3. side: of the tiles (m).
        resolution, method, query_options: as of a `GaussianMap`; the cutoff is that of the whole map.
        settings: of the tiles' files.
        n_read: number of tile files read so far.

    Raises `MissingDataError` if there is no index, and `DataError` if it is damaged.
    """

    def __init__(
        self,
        folder: str | Path,
        device: str | torch.device = "cpu",
        most_open: int = 16,
        memory_limit: int = 4 << 30,
    ) -> None:
        self.folder, self.device = Path(folder), torch.device(device)
        self.most_open = check_whole("most_open", most_open, 1)
        self.index, facts = read_index(self.folder / INDEX)
        self.dim, self.side = self.index.dim, float(facts["side"])
        self.settings = read_settings(facts, self.folder / INDEX)
        self.resolution, self.method = self.settings.resolution, self.settings.method
        query = self.settings.query
        self._cutoff = self.index.cutoff if query.cutoff is None else query.cutoff
        self.query_options = replace(query, cutoff=self._cutoff, memory_limit=memory_limit)
        self.n_read = 0
        self._open: OrderedDict[int, Query] = OrderedDict()

    def __repr__(self) -> str:
        return (
            f"TiledMap({self.n_components} components in {self.dim}D, {len(self.index)} tiles of "
            f"{self.side:g} m, {self.nbytes} bytes, {self.folder})"
        )

    @property
    def _rule(self) -> Rule:
        """How probabilities follow from the evidence of all tiles. Written tiles state their calibration; of
        those of version 1.0 all are read once, for the ranges of the sensor model."""
        options = self.query_options
        if options.prior is None and options.calibration is None:
            known = Calibration.prior(mean_range(map(self.components, range(len(self.index)))))
            self.query_options = replace(options, calibration=known)
        return rule_of(self.query_options, ())

    @property
    def n_components(self) -> int:
        """Number of components in all tiles."""
        return int(self.index.n_components.sum())

    @property
    def nbytes(self) -> int:
        """Bytes of all files, the index included."""
        return int(self.index.n_bytes.sum()) + (self.folder / INDEX).stat().st_size

    # -- queries --------------------------------------------------------------------------------------

    def occupancy(
        self, points: ArrayLike, resolution: float | None = None, method: str | None = None
    ) -> Tensor | np.ndarray:
        """As `GaussianMap.occupancy` of the whole map. Tiles are opened one after the other.

        Method "monte_carlo" draws for each tile its share of `n_samples` rays.
        """
        query = check_queries(points, self.dim)
        method = self.method if method is None else method
        check_method(method)
        resolution = self.resolution if resolution is None else check_resolution(resolution)
        evidence = self._evidence(query.to(self.device), resolution, method)
        theta = probability(evidence.hits, evidence.misses, resolution, self.dim, self._rule)
        return theta.to(query.device) if isinstance(points, Tensor) else theta.detach().cpu().numpy()

    def _evidence(self, points: Tensor, resolution: float, method: str) -> PointEvidence:
        """Hits and misses (M,) at points (M, D), added up over the tiles."""
        hits = torch.zeros_like(points[:, 0])
        misses = hits.clone()
        finite = points.detach()[torch.isfinite(points).all(1)].cpu()
        if len(finite) == 0:
            return PointEvidence(hits, misses)
        low, high = (x.to(points.device) for x in self.index.boxes(resolution, self._cutoff))
        for row in self.near(finite.amin(0), finite.amax(0), resolution):
            inside = ((points >= low[row]) & (points <= high[row])).all(1).nonzero().squeeze(1)
            if len(inside):
                found = self._query(row).evidence_at(points[inside], resolution, method)
                hits, misses = (
                    hits.index_add(0, inside, found.hits),
                    misses.index_add(0, inside, found.misses),
                )
        return PointEvidence(hits, misses)

    def near(self, low: ArrayLike, high: ArrayLike, resolution: float | None = None) -> list[int]:
        """Rows of the index of the tiles that may give evidence in the box between two corners (D,), m.

        resolution: side (m) of the largest cube that is asked for; None: that of the map.
        """
        corners = [as_tensor(x, name, torch.float64, "cpu") for name, x in (("low", low), ("high", high))]
        for name, corner in zip(("low", "high"), corners, strict=True):
            if tuple(corner.shape) != (self.dim,) or bool(corner.isnan().any()):
                raise InvalidArgumentError(f"{name}={corner.tolist()} must be {self.dim} numbers (m).")
        side = self.resolution if resolution is None else check_resolution(resolution)
        first, last = self.index.boxes(side, self._cutoff)
        met = ((first <= corners[1]) & (last >= corners[0])).all(1)
        rows: list[int] = met.nonzero().squeeze(1).tolist()
        return rows

    def open(
        self, low: ArrayLike | None = None, high: ArrayLike | None = None, resolution: float | None = None
    ) -> GaussianMap:
        """A map of all tiles that give evidence in the box between two corners (D,), m; None: no limit.

        In the box it answers as the whole map, for cubes of side `resolution` (m) or less; None: that of the
        map. Its components have the ids (0, 0), (0, 1), …

        Raises `MemoryLimitError` if queries of the map would need more than the memory limit.
        """
        far = torch.full((self.dim,), math.inf)
        rows = self.near(-far if low is None else low, far if high is None else high, resolution)
        n, limit = int(self.index.n_components[rows].sum()), self.query_options.memory_limit
        if n * _BYTES_EACH > limit:
            raise MemoryLimitError(
                f"{len(rows)} tiles with {n:,} components need about {n * _BYTES_EACH:,} bytes, more than "
                f"memory_limit={limit:,}; give the bounds of a smaller box, or a higher limit."
            )
        found = Components.concatenate([Components.empty(self.dim), *map(self.components, rows)])
        numbers = torch.stack([torch.zeros(n, dtype=torch.int64), torch.arange(n)], 1)
        options = {**vars(self.query_options), "resolution": self.resolution, "method": self.method}
        return GaussianMap.of(replace(found, ids=numbers), codec=self.settings.codec, **options).to(
            self.device
        )

    def components(self, row: int) -> Components:
        """The components of the tile in a row of the index, on the CPU.

        Raises `MissingDataError` if the file is missing, and `DataError` if it is not the one of the index.
        """
        path = self.folder / tile_name(self.index.tiles[row].tolist())
        if not path.is_file():
            raise MissingDataError(f"{path} is missing, but {INDEX} lists it; {_REMEDY}.")
        n_bytes, crc32 = int(self.index.n_bytes[row]), int(self.index.crc32[row])
        if path.stat().st_size != n_bytes or zlib.crc32(data := path.read_bytes()) != crc32:
            raise DataError(f"{path} is not the file that {INDEX} lists; {_REMEDY}.")
        found, _ = read_map_bytes(data, path)
        if found.dim != self.dim or len(found) != int(self.index.n_components[row]):
            raise DataError(f"{path} has other components than {INDEX} states; {_REMEDY}.")
        self.n_read += 1
        return found

    def _query(self, row: int) -> Query:
        """The query of a tile. If too many are open, the least recently used one is dropped."""
        if row not in self._open:
            components = self.components(row).to(self.device)
            share = float(self.index.support[row] / self.index.support.sum().clamp_min(1e-300))
            n_samples = max(1, round(share * self.query_options.n_samples))
            self._open[row] = Query(components, replace(self.query_options, n_samples=n_samples))
        self._open.move_to_end(row)
        while len(self._open) > self.most_open:
            self._open.popitem(last=False)
        return self._open[row]


INDEX = "index.safetensors"
"""Name of the index file in the folder of a tiled map."""

_KIND, _VERSION = "gmmtorch.tiles", 1
_FARTHEST_TILE = 1 << 40
_LARGEST_COUNT = 1 << 53  # sums of such counts stay exact


@dataclass(frozen=True, eq=False)
class TileIndex:
    """T tiles of a tiled map.

    tiles (T, 2): the tile contains the means with floor(x / side), floor(y / side). Distinct.
    low, high (T, D): a box (m) around the components, to their cutoff, and their sensor origins.
    distance (T,): longest distance (m) from a mean to its sensor origin.
    support (T,): sum of the supports, points.
    n_components, n_bytes, crc32 (T,): number of components, and length and CRC-32 of the file.
    n_seen, n_many (T,): viewpoints with a count, and those with many points; they decide the cutoff.
    """

    tiles: Tensor
    low: Tensor
    high: Tensor
    distance: Tensor
    support: Tensor
    n_components: Tensor
    n_bytes: Tensor
    crc32: Tensor
    n_seen: Tensor
    n_many: Tensor

    def __len__(self) -> int:
        return len(self.tiles)

    @property
    def dim(self) -> int:
        return self.low.shape[1]

    @property
    def cutoff(self) -> float:
        """The cutoff that follows from the support of all components."""
        return cutoff_of(int(self.n_seen.sum()), int(self.n_many.sum()))

    def boxes(self, side: float, cutoff: float) -> tuple[Tensor, Tensor]:
        """`evidence_boxes` of the tiles."""
        return evidence_boxes(self.low, self.high, self.distance, side, cutoff)

    @classmethod
    def joined(cls, rows: Sequence[dict[str, Any]], dim: int) -> TileIndex:
        """The index of rows of `index_row`."""
        columns = {}
        for name, (shape, dtype) in _columns(dim).items():
            values = [torch.as_tensor(row[name], dtype=dtype) for row in rows]
            columns[name] = torch.stack(values) if values else torch.zeros(0, *shape, dtype=dtype)
        return cls(**columns)

    def to_bytes(self, **facts: Any) -> bytes:
        """The index file; `facts` are JSON values."""
        return pack_tensors(vars(self), _KIND, _VERSION, **facts)


def _columns(dim: int) -> dict[str, tuple[tuple[int, ...], torch.dtype]]:
    """Shape and type of a row of each column."""
    shapes: dict[str, tuple[int, ...]] = {"tiles": (2,), "low": (dim,), "high": (dim,)}
    real = ("low", "high", "distance", "support")
    return {
        f.name: (shapes.get(f.name, ()), torch.float64 if f.name in real else torch.int64)
        for f in fields(TileIndex)
    }


def index_row(
    tile: Sequence[int], components: Components, cutoff: float | None, n_bytes: int, crc32: int
) -> dict[str, Any]:
    """The row of a tile with these components; `cutoff` None: the one that follows from their support."""
    cones = components.cones()
    low, high = cone_bounds(cones, CUTOFF if cutoff is None else cutoff)
    low, high = (torch.cat([corner, components.means]) for corner in (low, high))
    distance = (cones.means - cones.origins).norm(dim=1)
    n_seen, n_many = count_many(cones.counts)
    return {
        "tiles": list(tile),
        "low": low.amin(0),
        "high": high.amax(0),
        "distance": distance.amax() if len(distance) else 0.0,
        "support": components.support.sum(),
        "n_components": len(components),
        "n_bytes": n_bytes,
        "crc32": crc32,
        "n_seen": n_seen,
        "n_many": n_many,
    }


def read_index(path: Path) -> tuple[TileIndex, dict[str, Any]]:
    """The index and its facts; `side` (m) is checked, the others are not.

    Raises `MissingDataError` if the file does not exist, and `DataError` if it is damaged.
    """
    tensors, facts = read_tensors(path, _KIND, _VERSION)
    low = tensors.get("low")
    dim = low.shape[1] if low is not None and low.ndim == 2 else 0
    if dim not in (2, 3):
        raise DataError(f"{path} has tiles of {dim} dimensions; a map has 2 or 3. The file is damaged.")
    n_tiles = len(tensors["low"])
    index = TileIndex(
        **{
            name: require(tensors, name, (n_tiles, *shape), dtype, path)
            for name, (shape, dtype) in _columns(dim).items()
        }
    )
    try:
        check_number("side", facts.get("side"), above=True)
    except GmmTorchError as error:
        raise DataError(f"{path}: {error} The file is damaged.") from error
    _check(index, path)
    return index, facts


def _check(index: TileIndex, path: Path) -> None:
    """Raises `DataError` for values that no index has."""
    limits = {
        "tiles": (-_FARTHEST_TILE, _FARTHEST_TILE),
        "low": (-2 * FARTHEST, 2 * FARTHEST),
        "high": (-2 * FARTHEST, 2 * FARTHEST),
        "distance": (0, 4 * FARTHEST),
        "support": (0, float(_LARGEST_COUNT) ** 2),
        "n_bytes": (1, MAX_FILE_BYTES),
        "crc32": (0, (1 << 32) - 1),
        **dict.fromkeys(("n_components", "n_seen", "n_many"), (0, _LARGEST_COUNT)),
    }
    for name, (least, most) in limits.items():
        values = getattr(index, name)
        if bool(((values < least) | (values > most)).any()):
            raise DataError(f"{path}: {name} has values outside {least} to {most}; the file is damaged.")
    if bool((index.low > index.high).any()):
        raise DataError(f"{path}: a box has its lowest corner above its highest; the file is damaged.")
    if len(torch.unique(index.tiles, dim=0)) != len(index):
        raise DataError(f"{path} lists a tile twice; the file is damaged.")


def tile_name(tile: Sequence[int]) -> str:
    """Name of the file of a tile (2,)."""
    return f"tile_{tile[0]}_{tile[1]}.safetensors"


SIDE = 100.0
"""Side (m) of the tiles if none is given."""

_RULE = IncrementalRule()  # in the files of tiles; a map that continues from one adapts it to its scans


def tile_files(components: Components, settings: MapSettings, side: float = SIDE) -> dict[str, bytes]:
    """The files of a tiled map by name: its tiles, and last its index.

    Args:
        components: as the codec rounds them, such as `GaussianMap.components()`.
        settings: of the files. Components get new ids.
        side: of the tiles (m).
    """
    check_number("tile", side, above=True)
    settings = _calibrated(replace(settings, robot=0), components)
    place = (components.means[:, :2].detach() / side).floor().long()
    tiles, which = torch.unique(place, dim=0, return_inverse=True)
    files, rows = {}, []
    for number, tile in enumerate(tiles.tolist()):
        own = (which == number).nonzero().squeeze(1)
        files[tile_name(tile)], row = _tile(tile, components.selected(own), settings, None)
        rows.append(row)
    files[INDEX] = _index(rows, components.dim, settings, side)
    return files


def merge(
    folder: str | Path,
    parts: Sequence[TiledMap],
    tile_bytes: int | None = None,
    on_event: Callable[[str, int, int | None], None] | None = None,
) -> TiledMap:
    """Merges tiled maps into a folder, with one tile in memory at a time.

    The files depend on the components of the parts, not on their order. Without a budget the evidence of the
    result is the sum of that of the parts, and merging is associative.

    Args:
        folder: an earlier merge in it is replaced.
        parts: at least one; with equal settings and sides.
        tile_bytes: budget of each file: components are merged as under `max_bytes` of an `IncrementalRule`.
            None: no budget.
        on_event: called with ("merging tiles", done, total) after each tile.

    Raises `InvalidArgumentError` for parts that differ in dimension, side or settings.
    """
    if not parts:
        raise InvalidArgumentError("parts is empty; give at least one tiled map.")
    if tile_bytes is not None:
        check_whole("tile_bytes", tile_bytes, 1)
    first, folder = parts[0], Path(folder)
    known = [part.settings.query.calibration for part in parts]
    calibration = Calibration.merged([one for one in known if one is not None]) if any(known) else None
    settings = _with(first.settings, calibration)
    for part in parts[1:]:
        for name in ("dim", "side", "settings"):
            found = [getattr(one, name) for one in (part, first)]
            if name == "settings":
                found = [_with(one, None) for one in found]
            if found[0] != found[1]:
                raise InvalidArgumentError(
                    f"{part.folder} has {name}={found[0]}, but {first.folder} has {found[1]}; map all "
                    "recordings with the same options."
                )
    owners: dict[tuple[int, ...], list[tuple[TiledMap, int]]] = {}
    for part in parts:
        for number, tile in enumerate(part.index.tiles.tolist()):
            owners.setdefault(tuple(tile), []).append((part, number))
    (folder / INDEX).unlink(missing_ok=True)  # a merge that is stopped leaves no index, not a wrong one
    for path in {*folder.glob("tile_*.safetensors")} - {folder / tile_name(tile) for tile in owners}:
        path.unlink()
    rows = []
    for done, tile in enumerate(sorted(owners), 1):
        joined = Components.concatenate([part.components(number) for part, number in owners[tile]])
        data, row = _tile(tile, joined, settings, tile_bytes)
        write_bytes(folder / tile_name(tile), data)
        rows.append(row)
        if on_event is not None:
            on_event("merging tiles", done, len(owners))
    write_bytes(folder / INDEX, _index(rows, first.dim, settings, first.side))
    return TiledMap(folder, first.device)


def _calibrated(settings: MapSettings, components: Components) -> MapSettings:
    """The settings with the calibration of the sensor model, for the ranges of the components, if they have
    none. A tile alone does not show these ranges."""
    if settings.query.calibration is not None or settings.query.prior is not None:
        return settings
    return _with(settings, Calibration.prior(mean_range([components])))


def _with(settings: MapSettings, calibration: Calibration | None) -> MapSettings:
    return replace(settings, query=replace(settings.query, calibration=calibration))


def _tile(
    tile: Sequence[int], components: Components, settings: MapSettings, tile_bytes: int | None
) -> tuple[bytes, dict[str, Any]]:
    """The file of a tile, and its row of the index."""
    found = canonical(components)
    if tile_bytes is not None:
        size = partial(file_size, rule=_RULE, settings=settings, next_number=0)
        found = compact_to_bytes(found, tile_bytes, _RULE.max_origins, _RULE.mean_origins, size)
        found = canonical(found if settings.codec == "float" else quantized(found))
    data = map_bytes(found, _RULE, settings, 0)
    return data, index_row(tile, found, settings.query.cutoff, len(data), zlib.crc32(data))


def _index(rows: Sequence[dict[str, Any]], dim: int, settings: MapSettings, side: float) -> bytes:
    return TileIndex.joined(rows, dim).to_bytes(side=float(side), **settings_facts(settings))


def canonical(components: Components) -> Components:
    """The same components on the CPU in an order that depends on their values alone: by place.

    Ids are (0, 0), (0, 1), … Origins are distinct and sorted, and all used.
    """
    c = components.on_cpu()
    origins, seen_from = torch.unique(c.origins[c.seen_from] + 0.0, dim=0, return_inverse=True)  # no −0
    c = replace(c, origins=origins, seen_from=seen_from)
    c = _viewpoints_in_order(c.rearranged(_order(c)))
    numbers = torch.stack([torch.zeros(len(c), dtype=torch.int64), torch.arange(len(c))], 1)
    return replace(c, ids=numbers)


def _order(components: Components) -> Tensor:
    """An order (K,) by place, and then by all values. Only equal components keep their order."""
    c = components
    columns = [*c.means.T, *c.covariances.flatten(1).T, c.support, c.max_range, _viewpoint_hashes(c)]
    by_value = torch.from_numpy(np.lexsort([column.numpy() for column in columns[::-1]]))
    return by_value[spatial_order(c.selected(by_value))]  # a stable sort


def _viewpoint_hashes(components: Components) -> Tensor:
    """A hash (K,) int64 of the viewpoints of each component, which does not depend on their order."""
    c = components
    values = torch.cat([c.origins[c.seen_from], c.seen_count[:, None]], 1).contiguous().view(torch.int64)
    word = torch.zeros_like(c.seen_by)
    for column in values.T:
        word = (word ^ column) * 0x2545F4914F6CDD1D  # products modulo 2⁶⁴
        word = word ^ (word >> 29)
    return torch.zeros(len(c), dtype=torch.int64).index_add_(0, c.seen_by, word)


def _viewpoints_in_order(components: Components) -> Components:
    """The same components with their viewpoints sorted by component and origin."""
    c = components
    order = torch.from_numpy(np.lexsort([c.seen_from.numpy(), c.seen_by.numpy()]))
    return replace(c, seen_by=c.seen_by[order], seen_from=c.seen_from[order], seen_count=c.seen_count[order])
