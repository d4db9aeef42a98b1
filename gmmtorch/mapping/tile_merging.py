"""The files of tiled maps: made from components, and merged from the tiles of several recordings."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_number, check_whole
from gmmtorch.files import write_bytes
from gmmtorch.mapping.codec import map_file
from gmmtorch.mapping.codec.map_file import MapSettings
from gmmtorch.mapping.codec.quantization import quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.merging import compact_to_bytes
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.query import mean_range
from gmmtorch.mapping.tile_index import INDEX, TileIndex, index_row, tile_name
from gmmtorch.mapping.tiles import TiledMap
from gmmtorch.occupancy import Calibration

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
    return _with(settings, Calibration.prior(mean_range([components.cones()])))


def _with(settings: MapSettings, calibration: Calibration | None) -> MapSettings:
    return replace(settings, query=replace(settings.query, calibration=calibration))


def _tile(
    tile: Sequence[int], components: Components, settings: MapSettings, tile_bytes: int | None
) -> tuple[bytes, dict[str, Any]]:
    """The file of a tile, and its row of the index."""
    found = canonical(components)
    if tile_bytes is not None:
        size = partial(map_file.file_size, rule=_RULE, settings=settings, next_number=0)
        found = compact_to_bytes(found, tile_bytes, _RULE.max_origins, _RULE.mean_origins, size)
        found = canonical(found if settings.codec == "float" else quantized(found))
    data = map_file.to_bytes(found, _RULE, settings, 0)
    return data, index_row(tile, found, settings.query.cutoff, len(data), zlib.crc32(data))


def _index(rows: Sequence[dict[str, Any]], dim: int, settings: MapSettings, side: float) -> bytes:
    return TileIndex.joined(rows, dim).to_bytes(side=float(side), **map_file.settings_facts(settings))


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
