"""The files of a tiled map: its tiles, each with its row of the index, and the index."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gmmtorch.mapping.codec.component_batch import MapSettings, file_size, map_bytes, settings_facts
from gmmtorch.mapping.codec.quantization import quantized, spatial_order
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.learning.merging import compact_to_bytes
from gmmtorch.mapping.learning.rules import IncrementalRule
from gmmtorch.mapping.query import mean_range
from gmmtorch.mapping.tiles.tile_index import INDEX, TileIndex, check_side, index_row, tile_name
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
    check_side("tile", side)
    settings = calibrated(replace(settings, robot=0), components)
    files, rows = {}, []
    for tile, part in by_tile(components, side):
        files[tile_name(tile)], row = tile_file(tile, part, settings, None)
        rows.append(row)
    files[INDEX] = index_file(rows, components.dim, settings, side)
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


def index_file(rows: Sequence[dict[str, Any]], dim: int, settings: MapSettings, side: float) -> bytes:
    """The index of tiles of `side` (m), from their rows."""
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
