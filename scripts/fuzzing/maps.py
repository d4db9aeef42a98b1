"""Readers of mixtures, meshes, octrees and grids, and of maps, their tiles and checkpoints."""

from __future__ import annotations

import contextlib
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import torch
from fuzzing.hostile_bytes import changed_tensors, changed_zip, mended_tensors
from fuzzing.target import Target, in_folder, taken

import gmmtorch as gt
from gmmtorch import datasets
from gmmtorch.mapping import MapBuilder, TiledMap, tile_files


def mixtures(folder: Path, points: torch.Tensor) -> dict[str, Target]:
    """Mixtures of other programs and our own, meshes and octrees."""
    from gmmtorch import export
    from gmmtorch.datasets import read_triangles

    mixture = gt.GaussianMixture(2, random_state=0).fit(points.numpy())
    mixture.save(folder / "mixture.safetensors")
    weights, means, covariances = mixture.weights_, mixture.means_, mixture.covariances_
    numbers = [np.asarray(value) for value in (weights, means, covariances)]
    np.savez_compressed(
        folder / "a.npz", **dict(zip(("weights", "means", "covariances"), numbers, strict=True))
    )
    plain = export.read_npz(folder / "a.npz")
    export.write_gira_csv(folder / "a.csv", plain)
    built = gt.GaussianMap()
    built.insert(gt.Scan(points, torch.zeros(3)))
    built.finish()
    for name in ("s.ply", "s.spz"):
        export.write_splats(folder / name, export.Splats.of(built.components()))
    corners = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n" * 2
    axes = b"".join(b"property float %c\n" % axis for axis in b"xyz")
    ply = b"ply\nformat ascii 1.0\nelement vertex 3\n" + axes
    ply += b"element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    ply += b"0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    stl = bytes(80) + struct.pack("<I", 2) + struct.pack("<12fH", *range(12), 0) * 2
    found = {
        "mixture": Target(
            taken(folder, "mixture.safetensors"), gt.GaussianMixture.load, mended_tensors, changed_tensors
        ),
        "npz": Target(taken(folder, "a.npz"), export.read_npz, change=changed_zip),
        "npz as a whole": Target(taken(folder, "a.npz"), export.read_npz),
        "csv": Target(taken(folder, "a.csv"), export.read_gira_csv),
        "splats": Target(taken(folder, "s.ply", "s.spz"), export.read_splats),
        "meshes": Target({"a.obj": corners, "a.stl": stl, "a.ply": ply}, read_triangles),
    }
    with contextlib.suppress(ImportError):
        from gmmtorch.experiments.baselines import OctoMapMap

        octree = OctoMapMap(0.5)
        octree.insert(gt.Scan(points[:20], torch.zeros(3)))
        octree.save(folder / "a.ot")
        found["octree"] = Target(taken(folder, "a.ot"), OctoMapMap.from_octree)
    return found


def maps(folder: Path, scans: list[Any]) -> dict[str, Target]:
    """Maps, their tiles, checkpoints and grids: each changed as a whole, and behind its checksums."""
    from gmmtorch.mapping.tiles.tile_files import read_index
    from gmmtorch.occupancy import OccupancyGrid

    built = gt.GaussianMap()
    data = datasets.load("synthetic_building", n_scans=2)
    builder = MapBuilder(data, built)
    for _ in builder.insert_all():
        pass
    built.save(folder / "whole.safetensors")
    builder.save(folder / "checkpoint.safetensors", {})
    exact = gt.GaussianMap(codec="float")
    coloured = gt.GaussianMap()
    for scan in scans:
        exact.insert(scan)
        n = len(scan.points)
        channels = {"colour": torch.rand(n, 3), "class": torch.arange(n) % 4, "intensity": torch.rand(n)}
        coloured.insert(gt.Scan(scan.points, scan.origin, attributes=channels))
    for name, one in {"exact": exact, "coloured": coloured}.items():
        one.finish()
        one.save(folder / f"{name}.safetensors")
    grid = OccupancyGrid(0.5)
    grid.insert(scans[0])
    grid.save(folder / "grid.safetensors")
    tiles = tile_files(coloured.components(), coloured.settings)
    index, tile = "index.safetensors", next(name for name in tiles if name.startswith("tile"))

    def read_map(path: Path) -> None:
        found = gt.GaussianMap.load(path)
        found.occupancy(torch.zeros(1, found.dim or 3, dtype=torch.float64))

    def read_tiles(place: Path) -> None:
        """The index states the tile that is there, so that the tile's content is what decides."""
        content = (place / tile).read_bytes()
        if content != tiles[tile]:
            known, facts = read_index(place / index)
            row = [f"tile_{a}_{b}.safetensors" for a, b in known.tiles.tolist()].index(tile)
            known.n_bytes[row], known.crc32[row] = len(content), zlib.crc32(content)
            (place / index).write_bytes(known.to_bytes(facts.pop("side"), coloured.settings, **facts))
        found = TiledMap(place)
        for row in found.near([-9, -9, -9], [9, 9, 9])[:3]:
            found.components(row)

    def continued(path: Path) -> None:
        MapBuilder(data, gt.GaussianMap()).load(path, {})

    seeds = taken(folder, "exact.safetensors", "coloured.safetensors")
    behind = {"mend": mended_tensors, "change": changed_tensors}
    return {
        "map": Target(seeds, read_map, mended_tensors),
        "map behind": Target(seeds, read_map, **behind),
        "checkpoint": Target(taken(folder, "checkpoint.safetensors"), continued, **behind),
        "grid": Target(taken(folder, "grid.safetensors"), OccupancyGrid.load, **behind),
        "tiles": in_folder(tiles, {"i.safetensors": index, "t.safetensors": tile}, read_tiles, **behind),
    }
