"""TiledMap: a map in files of square tiles. A query opens only the tiles that it needs.

A component belongs to the tile that contains its mean. Its evidence reaches into other tiles, because its
rays start at the sensor. The index therefore states for each tile a box outside which its components give
no evidence. Evidence of components adds up, so the answers are those of the whole map, up to the rounding of
sums.

A map that grows has one more file, with the components of recent windows.
Files are never changed: new ones have other names, and count once the index names them. So a map that is
stopped at any moment opens with all finished windows. The next write removes what an interrupted one left.
One object writes at a time: it locks the folder from its first scan to `finish`, or to its end.
"""

from __future__ import annotations

import math
import os
import re
import zlib
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import replace
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
    OutputError,
    check_whole,
)
from gmmtorch.files import FileLock, write_bytes
from gmmtorch.mapping.codec.component_batch import read_map, read_settings
from gmmtorch.mapping.components import Components
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.windows import keeps_components
from gmmtorch.mapping.query import Query, count_many, cutoff_of, mean_range, rule_of
from gmmtorch.mapping.query_options import check_method
from gmmtorch.mapping.tiles.tile_files import (
    INDEX,
    SIDE,
    TileIndex,
    by_tile,
    calibrated,
    check_side,
    read_index,
    tile_file,
    tile_name,
    with_calibration,
)
from gmmtorch.occupancy import (
    CUTOFF,
    Calibration,
    PointEvidence,
    Rule,
    check_queries,
    check_resolution,
    probability,
)
from gmmtorch.scan import Scan

_BYTES_EACH = 1536  # memory of a component that answers queries, with its part of the spatial index
_RECENT = 4096  # components in memory before the older half goes into tiles
_REMEDY = (
    "open the map again if another process changes it; otherwise copy the folder again from where it was "
    "written, or merge the recordings again"
)
_LOCK = ".lock"
_WRITTEN = re.compile(r"\.?(tile_-?\d+_-?\d+|recent|index)(_[0-9a-f]{8})?(\.[0-9a-f]{16})?\.safetensors")
"""Names of files that a map writes; with a dot before an interrupted write has renamed them."""


class TiledMap:
    """A map in a folder: one map file for each tile, and an index file.

        tiled = TiledMap("outputs/map/RUN/tiles")
        tiled.occupancy(points)  # opens the tiles that give evidence at the points
        tiled.open(low, high)  # a GaussianMap of the tiles that give evidence in a box

        growing = TiledMap.create("city", GaussianMap(), dim=3, memory=10**9)
        growing.insert(scan)  # writes the components of each full window

    `tile_files` and `merge` make such folders, too; their maps do not grow.

    Args:
        folder: with the index file.
        device: of the evidence.
        memory: bytes of the tiles that stay in memory between queries, at most, or a single tile.
        memory_limit: bytes of the evidence, and of the components of an opened box, at most.

    Attributes:
        index: see `TileIndex`. dim: 2 or 3. side: of the tiles (m).
        resolution, method, query_options: as of a `GaussianMap`; the cutoff is that of the whole map.
        settings: of the tiles' files.
        n_scans: number of scans of all finished windows, which are in the files.
        n_read: number of tile files read so far.

    Raises `MissingDataError` if there is no index, and `DataError` if it is damaged.
    """

    def __init__(
        self,
        folder: str | Path,
        device: str | torch.device = "cpu",
        memory: int = 1 << 30,
        memory_limit: int = 4 << 30,
    ) -> None:
        self.folder, self.device = Path(folder), torch.device(device)
        self.memory = check_whole("memory", memory, 1)
        self.index, facts = read_index(self.folder / INDEX)
        self.dim, self.side = self.index.dim, float(facts["side"])
        self.settings = read_settings(facts, self.folder / INDEX)
        self.resolution, self.method = self.settings.resolution, self.settings.method
        self._cutoff, self._memory_limit = CUTOFF, memory_limit
        self.query_options = self.settings.query
        self.n_read = 0
        self._open: OrderedDict[str, tuple[Query, int]] = OrderedDict()
        self._crc32 = int(facts.get("recent", 0))  # of the file with the recent components
        self._recent = self._read_recent() if "recent" in facts else None
        self.n_scans = self._n_inserted = int(facts.get("n_scans", 0))
        self._lock = FileLock(self.folder / _LOCK)
        self._update()

    @classmethod
    def create(
        cls, folder: str | Path, target: GaussianMap, dim: int, side: float = SIDE, **options: Any
    ) -> TiledMap:
        """A map that grows in a folder, with the learning and the settings of `target`, which it takes over.

        Args:
            dim: 2 or 3, of the scans.
            side: of the tiles (m).
            options: as for `TiledMap`.

        Raises `InvalidArgumentError` if the folder has an index, or the rule needs all of the map: with
        novelty, forgetting or a budget.
        """
        folder = Path(folder)
        if (folder / INDEX).exists():
            raise InvalidArgumentError(f"{folder} has a map; open it by TiledMap, or choose another folder.")
        if not keeps_components(target.learning):
            raise InvalidArgumentError(
                "The learning rule has novelty, forgetting or a budget, which need all of the map; give a "
                "rule without them."
            )
        check_side("side", side)
        target._prepare(dim, torch.device("cpu"), "dim is")
        data, settings = target._file(), replace(target.settings, robot=0)
        write_bytes(folder / _recent_name(zlib.crc32(data)), data)
        index = TileIndex.joined([], dim).to_bytes(side, settings, recent=zlib.crc32(data))
        write_bytes(folder / INDEX, index)
        made = cls(folder, **options)
        made._recent = target.to(made.device)
        return made

    def _read_recent(self) -> GaussianMap:
        path = self.folder / _recent_name(self._crc32)
        if path.is_file() and zlib.crc32(path.read_bytes()) != self._crc32:
            raise DataError(f"{path} is not the file that {INDEX} lists; {_REMEDY}.")
        recent = GaussianMap.load(path)
        if recent.dim != self.dim:
            raise DataError(
                f"{path} is a map in {recent.dim}D, but {INDEX} is of one in {self.dim}D; {_REMEDY}."
            )
        return recent.to(self.device)

    def _update(self) -> None:
        """Brings cutoff and calibration up to date with all components."""
        given, counts = self.settings.query.cutoff, [self.index.n_seen.sum(), self.index.n_many.sum()]
        if self._recent is not None:
            added = count_many(self._recent._final().seen_count)
            counts = [count + more for count, more in zip(counts, added, strict=True)]
        cutoff = cutoff_of(*map(int, counts)) if given is None else given
        if cutoff != self._cutoff:
            self._open.clear()
        self._cutoff = cutoff
        self.query_options = replace(self.settings.query, cutoff=cutoff, memory_limit=self._memory_limit)
        if self._recent is not None:
            own = cutoff if len(self.index) else given  # without tiles the unfinished window counts, too
            self._recent._query_options = replace(self._recent._query_options, cutoff=own)

    @property
    def n_pending(self) -> int:
        """Number of scans of the unfinished window, which are not in the files."""
        return 0 if self._recent is None else self._recent.n_pending

    def insert(self, scan: Scan) -> None:
        """Learns from a scan. Queries use it at once; it is in the files when its window is full.

        The cost does not depend on the size of the map. Raises `InvalidArgumentError` if the map does not
        grow, and `OutputError` if a file cannot be written: the scan is then in memory, and the next full
        window, or `finish`, writes it. Also raises `OutputError` while another object, of this or another
        process, writes the map.
        """
        self._growing().insert(scan)
        self._n_inserted += 1
        if not self.n_pending:
            self._store()

    def finish(self) -> None:
        """Ends the unfinished window, writes all that is not in the files, and lets other objects write."""
        recent = self._growing()
        if recent.n_pending:
            recent.revise(lambda components: components)
        self._store()
        self._lock.release()

    def add(self, components: Components) -> None:
        """Adds components, such as those of another map, and writes them. An unfinished window ends.

        Until the first full window the calibration is that of the sensor model for the first components.
        """
        recent = self._growing()
        numbers = recent._next_number + torch.arange(len(components), device=self.device)
        ids = torch.stack([torch.full_like(numbers, recent.robot), numbers], 1)
        added = replace(components.to(self.device), ids=ids)
        recent.revise(lambda known: Components.concatenate([known, added]))
        self._store()

    def _growing(self) -> GaussianMap:
        """The recent components, for a change of the map."""
        if self._recent is None:
            raise InvalidArgumentError(f"{self.folder} has merged tiles, which do not grow; use `create`.")
        if self._lock.hold():
            try:
                self._check_current()
            except GmmTorchError:
                self._lock.release()
                raise
        return self._recent

    def _check_current(self) -> None:
        """Raises `OutputError` if the files are not those that were read or written here."""
        if read_index(self.folder / INDEX)[1].get("recent") != self._crc32:
            raise OutputError(
                f"{self.folder} cannot be written: another process has changed the map since it was opened "
                "here. Open it again by TiledMap, and insert again what it does not contain."
            )

    def _store(self) -> None:
        """Writes the recent components; if there are more than `_RECENT`, the older ones into tiles."""
        recent, known = self._growing(), self.settings.query
        found, query = recent.components(), recent.query_options
        query = replace(query, cutoff=known.cutoff, calibration=query.calibration or known.calibration)
        settings = calibrated(replace(recent.settings, query=query, robot=0), found)
        n_old = len(found) - _RECENT // 2 if len(found) > _RECENT else 0
        rows, index = [], self.index
        number = {tuple(tile): row for row, tile in enumerate(index.tiles.tolist())} if n_old else {}
        for tile, part in by_tile(found.selected(torch.arange(n_old, device=self.device)), self.side):
            row = number.get(tuple(tile))
            parts = [part.on_cpu()] if row is None else [self.components(row), part.on_cpu()]
            data, made = tile_file(tile, Components.concatenate(parts), settings, None)
            write_bytes(self.folder / tile_name(tile, made["crc32"]), data)
            rows.append(made)
        if rows:
            index = index.replaced(rows)
        left = torch.arange(n_old, len(found), device=self.device)
        data = recent._file(found.selected(left).with_used_origins())
        crc32 = zlib.crc32(data)
        write_bytes(self.folder / _recent_name(crc32), data)
        facts = {"recent": crc32, "n_scans": self._n_inserted}
        write_bytes(self.folder / INDEX, index.to_bytes(self.side, settings, **facts))
        self.index, self.settings, self._crc32, self.n_scans = index, settings, crc32, self._n_inserted
        if n_old:
            recent.revise(lambda components: components.selected(left).with_used_origins())
        self._update()
        _remove_others(
            self.folder, {_recent_name(crc32), *map(tile_name, index.tiles.tolist(), index.crc32.tolist())}
        )

    def _name(self, row: int) -> str:
        crc32 = None if self._recent is None else int(self.index.crc32[row])
        return tile_name(self.index.tiles[row].tolist(), crc32)

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
            if self._recent is not None:  # its first window is not finished
                return self._recent._answers().rule
            known = Calibration.prior(mean_range(map(self.components, range(len(self.index)))))
            self.query_options = replace(options, calibration=known)
        return rule_of(self.query_options, ())

    @property
    def n_components(self) -> int:
        """Number of components without those of an unfinished window."""
        return int(self.index.n_components.sum()) + (self._recent.n_final if self._recent else 0)

    n_final = n_components

    @property
    def predictions(self) -> dict[float, Tensor]:
        """As `GaussianMap.predictions`, of the scans since the map was opened here."""
        return {} if self._recent is None else self._recent.predictions

    @property
    def nbytes(self) -> int:
        """Bytes of all files, the index included."""
        names = [INDEX] if self._recent is None else [INDEX, _recent_name(self._crc32)]
        return int(self.index.n_bytes.sum()) + sum((self.folder / name).stat().st_size for name in names)

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
        if self._recent is not None:
            hits, misses = self._recent._answers().evidence_at(points, resolution, method)
        finite = points.detach()[torch.isfinite(points).all(1)].cpu()
        if len(finite) == 0:
            return PointEvidence(hits, misses)
        low, high = (x.to(points.device) for x in self.index.boxes(resolution, self._cutoff))
        for row in self.near(finite.amin(0), finite.amax(0), resolution):
            inside = ((points >= low[row]) & (points <= high[row])).all(1).nonzero().squeeze(1)
            if len(inside):
                found = self._query(row).evidence_at(points[inside], resolution, method)
                hits = hits.index_add(0, inside, found.hits)
                misses = misses.index_add(0, inside, found.misses)
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
        recent = [] if self._recent is None else [self._recent.components().on_cpu()]
        n = int(self.index.n_components[rows].sum()) + sum(map(len, recent))
        limit = self.query_options.memory_limit
        if n * _BYTES_EACH > limit:
            raise MemoryLimitError(
                f"{len(rows)} tiles with {n:,} components need about {n * _BYTES_EACH:,} bytes, more than "
                f"memory_limit={limit:,}; give the bounds of a smaller box, or a higher limit."
            )
        found = Components.concatenate([Components.empty(self.dim), *map(self.components, rows), *recent])
        numbers = torch.stack([torch.zeros(n, dtype=torch.int64), torch.arange(n)], 1)
        options = {**vars(self.query_options), "resolution": self.resolution, "method": self.method}
        opened = GaussianMap.of(replace(found, ids=numbers), codec=self.settings.codec, **options)
        return opened.to(self.device)

    def components(self, row: int) -> Components:
        """The components of the tile in a row of the index, on the CPU.

        Raises `MissingDataError` if the file is missing, and `DataError` if it is not the one of the index.
        """
        path = self.folder / self._name(row)
        if not path.is_file():
            raise MissingDataError(f"{path} is missing, but {INDEX} lists it; {_REMEDY}.")
        n_bytes, crc32 = int(self.index.n_bytes[row]), int(self.index.crc32[row])
        if path.stat().st_size != n_bytes or zlib.crc32(data := path.read_bytes()) != crc32:
            raise DataError(f"{path} is not the file that {INDEX} lists; {_REMEDY}.")
        found, _ = read_map(path, data)
        if found.dim != self.dim or len(found) != int(self.index.n_components[row]):
            raise DataError(f"{path} has other components than {INDEX} states; {_REMEDY}.")
        self.n_read += 1
        return found

    def _query(self, row: int) -> Query:
        """The query of a tile. If the open ones need too much memory, the least recently used are dropped."""
        name = self._name(row)
        share = float(self.index.support[row] / self.index.support.sum().clamp_min(1e-300))
        n_samples = max(1, round(share * self.query_options.n_samples))
        options = replace(self.query_options, n_samples=n_samples)
        if name not in self._open:
            components = self.components(row).to(self.device)
            self._open[name] = Query([components], options), len(components) * _BYTES_EACH
        known, n_bytes = self._open[name]
        if known.options.n_samples != n_samples:  # other tiles have grown
            self._open[name] = Query(known.parts, options, (), known), n_bytes
        self._open.move_to_end(name)
        while len(self._open) > 1 and sum(n_bytes for _, n_bytes in self._open.values()) > self.memory:
            self._open.popitem(last=False)
        return self._open[name][0]


def _remove_others(folder: Path, names: set[str]) -> None:
    """Removes the files that a map of this folder has written, except its index and those of some names."""
    for name in {*os.listdir(folder)} - {INDEX, *names} if folder.exists() else ():
        if _WRITTEN.fullmatch(name):
            (folder / name).unlink(missing_ok=True)


def _recent_name(crc32: int) -> str:
    """Name of the file with the recent components of a map that grows."""
    return f"recent_{crc32:08x}.safetensors"


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
        folder: a map that is in it is replaced; it cannot be one of the parts.
        parts: at least one; with equal settings and sides. Recent components of one that grows are included.
        tile_bytes: budget of each file: components are merged as under `max_bytes` of an `IncrementalRule`.
            None: no budget.
        on_event: called with ("merging tiles", done, total) after each tile.

    Raises `InvalidArgumentError` for parts that differ in dimension, side or settings.
    """
    if not parts:
        raise InvalidArgumentError("parts is empty; give at least one tiled map.")
    if Path(folder).resolve() in {part.folder.resolve() for part in parts}:
        raise InvalidArgumentError(f"folder={folder} is that of a part; choose another folder.")
    if tile_bytes is not None:
        check_whole("tile_bytes", tile_bytes, 1)
    first, folder = parts[0], Path(folder)
    known = [part.settings.query.calibration for part in parts]
    calibration = Calibration.merged([one for one in known if one is not None]) if any(known) else None
    settings = with_calibration(first.settings, calibration)
    for part in parts[1:]:
        for name in ("dim", "side", "settings"):
            found = [getattr(one, name) for one in (part, first)]
            if name == "settings":
                found = [with_calibration(one, None) for one in found]
            if found[0] != found[1]:
                raise InvalidArgumentError(
                    f"{part.folder} has {name}={found[0]}, but {first.folder} has {found[1]}; map all "
                    "recordings with the same options."
                )
    owners: dict[tuple[int, ...], list[Callable[[], Components]]] = {}
    for part in parts:
        for number, tile in enumerate(part.index.tiles.tolist()):
            owners.setdefault(tuple(tile), []).append(partial(part.components, number))
        if part._recent is not None:
            for tile, recent in by_tile(part._recent.components(), first.side):
                owners.setdefault(tuple(tile), []).append(recent.on_cpu)
    lock = FileLock(folder / _LOCK)
    lock.hold()
    (folder / INDEX).unlink(missing_ok=True)  # a merge that is stopped leaves no index, not a wrong one
    _remove_others(folder, set(map(tile_name, owners)))
    rows = []
    for done, tile in enumerate(sorted(owners), 1):
        joined = Components.concatenate([components() for components in owners[tile]])
        data, row = tile_file(tile, joined, settings, tile_bytes)
        write_bytes(folder / tile_name(tile), data)
        rows.append(row)
        if on_event is not None:
            on_event("merging tiles", done, len(owners))
    write_bytes(folder / INDEX, TileIndex.joined(rows, first.dim).to_bytes(first.side, settings))
    lock.release()
    return TiledMap(folder, first.device)
