"""TiledMap: a map in files of square tiles. A query opens only the tiles that it needs.

A component belongs to the tile that contains its mean. Its evidence reaches into other tiles, because its
rays start at the sensor. The index therefore states for each tile a box outside which its components give
no evidence, and a query opens exactly the tiles whose box contains it. Evidence of components adds up, so
the answers are those of the whole map, up to the rounding of sums.
"""

from __future__ import annotations

import math
import zlib
from collections import OrderedDict
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from gmmtorch.arrays import ArrayLike, as_tensor
from gmmtorch.errors import (
    DataError,
    InvalidArgumentError,
    MemoryLimitError,
    MissingDataError,
    check_whole,
)
from gmmtorch.mapping.codec import map_file
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.query import Query, mean_range, rule_of
from gmmtorch.mapping.query_options import check_method
from gmmtorch.mapping.tile_index import INDEX, read_index, tile_name
from gmmtorch.occupancy import Calibration, PointEvidence, Rule, check_queries, check_resolution, probability

_BYTES_EACH = 4096  # memory of a component that answers queries, most of it in the spatial index
_REMEDY = "copy the folder again from where it was written, or merge the recordings again"


class TiledMap:
    """A map in a folder: one map file for each tile, and an index file.

        tiled = TiledMap("outputs/map/RUN/tiles")
        tiled.occupancy(points)  # opens the tiles that give evidence at the points
        tiled.open(low, high)  # a GaussianMap of the tiles that give evidence in a box

    `tile_merging` writes such folders.

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
        self.settings = map_file.read_settings(facts, self.folder / INDEX)
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
            cones = (self.components(row).cones() for row in range(len(self.index)))
            known = Calibration.prior(mean_range(cones))
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
        found, _ = map_file.from_bytes(data, path)
        if found.dim != self.dim or len(found) != int(self.index.n_components[row]):
            raise DataError(f"{path} has other components than {INDEX} states; {_REMEDY}.")
        self.n_read += 1
        return found

    def _query(self, row: int) -> Query:
        """The query of a tile. If too many are open, the least recently used one is dropped."""
        if row not in self._open:
            cones = self.components(row).to(self.device).cones()
            share = float(self.index.support[row] / self.index.support.sum().clamp_min(1e-300))
            n_samples = max(1, round(share * self.query_options.n_samples))
            self._open[row] = Query(cones, replace(self.query_options, n_samples=n_samples))
        self._open.move_to_end(row)
        while len(self._open) > self.most_open:
            self._open.popitem(last=False)
        return self._open[row]
