"""The files of a tiled map: its tiles, and the index, which says what each tile contains."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, check_number, check_whole
from gmmtorch.files import MAX_FILE_BYTES, pack_tensors, read_tensors, require
from gmmtorch.mapping.codec.component_batch import MapSettings, file_size, map_bytes, settings_facts
from gmmtorch.mapping.codec.quantization import quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.merging import compact_to_bytes
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.query import count_many, cutoff_of, evidence_boxes, mean_range
from gmmtorch.occupancy import CUTOFF, Calibration, cone_bounds
from gmmtorch.scan import FARTHEST

INDEX = "index.safetensors"
"""Name of the index file in the folder of a tiled map."""

_KIND, _VERSION, _GROWN = "gmmtorch.tiles", 1, 2  # tiles of a map that grows have their CRC-32 in their name
_FARTHEST_TILE = 1 << 40
_LEAST_SIDE = FARTHEST / _FARTHEST_TILE  # m
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

    def replaced(self, rows: Sequence[dict[str, Any]]) -> TileIndex:
        """The index with these rows of `index_row`, instead of those of their tiles."""
        made = TileIndex.joined(rows, self.dim)
        kept = ~(self.tiles[:, None] == made.tiles).all(2).any(1)
        return TileIndex(**{n: torch.cat([v[kept], getattr(made, n)]) for n, v in vars(self).items()})

    def to_bytes(self, side: float, settings: MapSettings, **facts: Any) -> bytes:
        """The index file of tiles of `side` (m); `facts` are JSON values. With `recent` among them it is of a
        map that grows."""
        version = _GROWN if "recent" in facts else _VERSION
        facts = {"side": float(side), **settings_facts(settings), **facts}
        return pack_tensors(vars(self), _KIND, version, **facts)


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
    """The index and its facts; `side` (m), `recent` and `n_scans` are checked, the others are not.

    Raises `MissingDataError` if the file does not exist, and `DataError` if it is damaged.
    """
    tensors, facts = read_tensors(path, _KIND, _VERSION, _GROWN)
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
        check_side("side", facts.get("side"))
        for name in {"recent", "n_scans"} & facts.keys():
            check_whole(name, facts[name], 0)
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


def check_side(name: str, side: Any) -> None:
    """Raises `InvalidArgumentError` for a side (m) with which numbers of tiles would be too large."""
    check_number(name, side, least=_LEAST_SIDE)


def tile_name(tile: Sequence[int], crc32: int | None = None) -> str:
    """Name of the file of a tile (2,). `crc32`: of the file, if the map grows."""
    return f"tile_{tile[0]}_{tile[1]}{'' if crc32 is None else f'_{crc32:08x}'}.safetensors"


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
    check_side("tile", side)
    settings = calibrated(replace(settings, robot=0), components)
    files, rows = {}, []
    for tile, part in by_tile(components, side):
        files[tile_name(tile)], row = tile_file(tile, part, settings, None)
        rows.append(row)
    files[INDEX] = TileIndex.joined(rows, components.dim).to_bytes(side, settings)
    return files


def by_tile(components: Components, side: float) -> Iterator[tuple[list[int], Components]]:
    """Each tile (2,) that contains means, and its components."""
    place = (components.means[:, :2].detach() / side).floor().long()
    tiles, which = torch.unique(place, dim=0, return_inverse=True)
    for number, tile in enumerate(tiles.tolist()):
        yield tile, components.selected((which == number).nonzero().squeeze(1))


def calibrated(settings: MapSettings, components: Components) -> MapSettings:
    """The settings with the calibration of the sensor model, for the ranges of the components, if they have
    none. A tile alone does not show these ranges."""
    if settings.query.calibration is not None or settings.query.prior is not None:
        return settings
    return with_calibration(settings, Calibration.prior(mean_range([components])))


def with_calibration(settings: MapSettings, calibration: Calibration | None) -> MapSettings:
    """The settings with a calibration of the answers, or without one."""
    return replace(settings, query=replace(settings.query, calibration=calibration))


def tile_file(
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


def canonical(components: Components) -> Components:
    """The same components on the CPU in an order that depends on their values alone: by place.

    Ids are (0, 0), (0, 1), … Origins are distinct and sorted, and all used.
    """
    c = components.on_cpu()
    origins, seen_from = torch.unique(c.origins[c.seen_from] + 0.0, dim=0, return_inverse=True)  # no −0
    c = replace(c, origins=origins, seen_from=seen_from)
    c = c.rearranged(_order(c))
    c = c.with_viewpoints(torch.from_numpy(np.lexsort([c.seen_from.numpy(), c.seen_by.numpy()])))
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
