"""Colour, intensity and classes at held-out points, beside grids of mean values.

    python benchmarks/attributes.py --data FOLDER

FOLDER holds kinect/ and courtyard/; building is simulated. Every 5th scan is held out. kinect: PSNR of sRGB
colours at points of held-out frames, from every 4th pixel of every 4th row. The colour camera was calibrated
on the other frames. building: share of points with the right class of floor, ceiling, wall and furniture.
courtyard: correlation of the reflectivity, and its RMS error. A cell of a grid takes 6 bytes for its place,
and 3 for a colour or 1 for an intensity or a class. *octree* is the same grid as a compressed octree, with
values in steps of 8 from their predecessors (LZMA); like the grid, it knows nothing of free space. *frames
before and after* are the 8 nearest points of the two neighbouring frames, within 3 cm: no map.
"""

from __future__ import annotations

import lzma
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import open3d as o3d
import torch
from scipy.spatial import cKDTree
from sklearn.metrics import roc_auc_score
from torch import Tensor

from gmmtorch import GaussianMap, IncrementalRule, Scan
from gmmtorch.datasets import load
from gmmtorch.experiments.harness import Case, Row, run
from gmmtorch.scan import display_colours, linear_colours
from gmmtorch.simulation import building_3d, poses_3d, simulate_scan, spinning_lidar
from gmmtorch.team.sharing import Replica

EVERY, N_POINTS, N_RUNS, STEP = 5, 60_000, 3, 8
COLOUR_INTRINSICS = "522.6 0 320\n0 522.6 240\n0 0 1\n"
COLOUR_POSE = "1 0 0 -0.0275\n0 1 0 -0.004\n0 0 1 0\n0 0 0 1\n"
PLACE_BYTES = 6
CELL = {"kinect": 0.05, "building": 0.1, "courtyard": 0.2}
BUDGETS: dict[str, tuple[int | None, ...]]
BUDGETS = {"kinect": (8000, 16_000, 32_000, None), "building": (8000,), "courtyard": (16_000, None)}


def kinect(data: Path) -> list[Scan]:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        for file in (data / "kinect").iterdir():
            (folder / file.name).symlink_to(file)
        (folder / "color-intrinsics.txt").write_text(COLOUR_INTRINSICS)
        (folder / "color-pose.txt").write_text(COLOUR_POSE)
        return list(load("depth_frames", folder, pixel_stride=4, up="-y", attributes=["colour"]))


def courtyard(data: Path) -> list[Scan]:
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        (folder / "scans").symlink_to(data / "courtyard" / "scans_intensity")
        (folder / "poses.txt").symlink_to(data / "courtyard" / "poses.txt")
        return list(load("scan_folder", folder, attributes=["intensity"]))


def building(_: Path) -> list[Scan]:
    """Lidar scans of the simulated building; a point has the class of the nearest triangle."""
    generator = torch.Generator().manual_seed(0)
    world, sensor = building_3d(generator), spinning_lidar()
    triangles = world.triangles.float().reshape(-1, 3).numpy()
    scene: Any = o3d.t.geometry.RaycastingScene()
    faces = np.arange(len(triangles), dtype=np.uint32).reshape(-1, 3)
    scene.add_triangles(o3d.core.Tensor(triangles), o3d.core.Tensor(faces))
    classes, scans = triangle_classes(world.triangles), []
    for pose in poses_3d(world.path, 60, 1.2):
        scan = simulate_scan(sensor, pose, world, generator)
        nearest = scene.compute_closest_points(o3d.core.Tensor(scan.points.float().numpy()))
        label = classes[torch.from_numpy(nearest["primitive_ids"].numpy().astype(np.int64))]
        scans.append(Scan(scan.points, scan.origin, attributes={"class": label}))
    return scans


def triangle_classes(triangles: Tensor) -> Tensor:
    """0: floor, 1: ceiling, 2: wall, 3: furniture. Boxes of floors, ceilings and walls come first."""
    from gmmtorch.simulation import buildings

    n_flat, n_walls = (
        sum(len(part) for part in parts)
        for parts in (buildings._floors_and_ceilings(), buildings._hall_walls())
    )
    label = torch.full((len(triangles),), 3)
    label[: n_flat + n_walls] = 2
    label[:n_flat] = (triangles[:n_flat, :, 2].mean(1) > 1.0).long()
    return label


SOURCES = {"kinect": kinect, "building": building, "courtyard": courtyard}


def built(scans: Sequence[Scan], max_bytes: int | None, with_channels: bool) -> tuple[GaussianMap, float]:
    """A map and the CPU seconds of learning."""
    begin = time.process_time()
    made = GaussianMap(IncrementalRule(max_bytes=max_bytes))
    for scan in scans:
        made.insert(scan if with_channels else Scan(scan.points, scan.origin))
    made.finish()
    return made, time.process_time() - begin


def sent(made: GaussianMap) -> str:
    """Bytes of datagrams for each component of the map, and without attributes."""
    sizes = []
    for channels in (None, ()):
        replica = Replica(0, channels=channels)
        replica.add(made.components())
        sizes.append(sum(map(len, replica.datagrams())) / len(made.components()))
    return "{:.1f} ({:.1f})".format(*sizes)


def known_points(scans: Sequence[Scan], channel: str) -> tuple[Tensor, Tensor]:
    points = torch.cat([scan.points for scan in scans]).double()
    values = torch.cat([scan.attributes[channel] for scan in scans])
    known = torch.isfinite(values).all(1) if values.is_floating_point() else values >= 0
    return points[known], values[known]


def grid(
    points: Tensor, values: Tensor, side: float, asked: Tensor, step: int = 0
) -> tuple[Tensor, Tensor, int, int]:
    """Mean value, or most frequent label, of the cell of each point; that of all where no point fell. Which
    points are known, the number of cells, and their bytes; with `step`, those of a compressed octree."""
    is_number = values.is_floating_point()
    target = values.double() if is_number else torch.nn.functional.one_hot(values).double()
    both = (torch.cat([points, asked]) / side).floor().long()
    cells, cell = torch.unique(both, dim=0, return_inverse=True)
    own, of_asked = cell[: len(points)], cell[len(points) :]
    count = torch.bincount(own, minlength=len(cells)).double()
    mean = target.new_zeros(len(cells), target.shape[1]).index_add_(0, own, target)
    mean /= count.clamp_min(1)[:, None]
    full = count > 0
    n = int(full.sum())
    n_bytes = n * (PLACE_BYTES + (values.shape[1] if is_number else 1))
    if step:
        is_colour = values.shape[1] == 3
        levels = (255 * display_colours(mean) if is_colour else mean).div(step).round()
        n_bytes = octree_bytes(cells[full].numpy(), levels[full].long().numpy())
        mean = linear_colours((levels * step / 255).clamp(0, 1)) if is_colour else levels * step
    known = full[of_asked]
    found = torch.where(known[:, None], mean[of_asked], target.mean(0))
    return found if is_number else found.argmax(1), known, n, n_bytes


def octree_bytes(cells: np.ndarray, levels: np.ndarray) -> int:
    """Bytes of an octree of cells (n, 3) as masks of children, and of their levels (n, 1 or 3): green, red
    and blue less green, each from the cell before in Morton order."""
    place, code = cells - cells.min(0), np.zeros(len(cells), np.int64)
    for bit in range(16):
        for axis in range(3):
            code |= ((place[:, axis] >> bit) & 1) << (3 * bit + axis)
    order = np.argsort(code)
    masks, left = [], code[order]
    while len(left) > 1 or not masks:
        parents, parent = np.unique(left >> 3, return_inverse=True)
        mask = np.zeros(len(parents), np.uint8)
        np.bitwise_or.at(mask, parent, (1 << (left & 7)).astype(np.uint8))
        masks, left = [mask, *masks], parents
    levels = levels[order]
    if levels.shape[1] == 3:
        levels = np.column_stack([levels[:, 1], levels[:, 0] - levels[:, 1], levels[:, 2] - levels[:, 1]])
    changes = np.diff(levels, axis=0, prepend=0).astype(np.int8)
    return sum(map(packed, (np.concatenate(masks), *changes.T)))


def packed(values: np.ndarray) -> int:
    code = {"id": lzma.FILTER_LZMA2, "preset": 9 | lzma.PRESET_EXTREME, "lc": 0, "lp": 0, "pb": 0}
    return len(lzma.compress(values.tobytes(), lzma.FORMAT_RAW, filters=[code]))


def score(channel: str, found: Tensor, true: Tensor) -> str:
    if channel == "colour":
        error = (display_colours(found.clamp(0, 1)) - display_colours(true.double())).square().mean()
        return f"{-10 * float(error.log10()):.2f} dB"
    if channel == "class":
        return f"{100 * float((found == true).double().mean()):.1f} %"
    found, true = found[:, 0].double(), true[:, 0].double()
    together = float(torch.corrcoef(torch.stack([found, true]))[0, 1])
    return f"{together:.3f}, {float((found - true).square().mean().sqrt()):.1f}"


def auc(made: GaussianMap, scans: Sequence[Scan], side: float) -> float:
    """Of the occupancy of ends of held-out beams and of a random point on each."""
    generator = torch.Generator().manual_seed(1)
    points, labels = [], []
    for scan in scans:
        rows = torch.randperm(len(scan.points), generator=generator)[:1500]
        ends = scan.points[rows].double()
        share = torch.rand(len(ends), 1, generator=generator, dtype=torch.float64)
        points += [ends, scan.origin + share * (ends - scan.origin)]
        labels += [torch.ones(len(ends)), torch.zeros(len(ends))]
    return float(roc_auc_score(torch.cat(labels), made.occupancy(torch.cat(points), side)))


def measure(options: Any) -> Iterator[Row]:
    for name in options.names:
        scans = SOURCES[name](options.data)
        channel = next(iter(scans[0].attributes))
        test = scans[::EVERY]
        train = [scan for number, scan in enumerate(scans) if number % EVERY]
        points, values = known_points(test, channel)
        rows = torch.randperm(len(points), generator=torch.Generator().manual_seed(0))[:N_POINTS]
        points, values = points[rows], values[rows]
        for budget in BUDGETS[name]:
            runs = [
                built(train, budget, with_channels) for _ in range(N_RUNS) for with_channels in (False, True)
            ]
            plain = min(seconds for _, seconds in runs[::2])
            made, seconds = min(runs[1::2], key=lambda pair: pair[1])
            found = made.attributes(points)[channel]
            value = found.most_likely if channel == "class" else found.mean
            size = f"map, {len(made.components()):,} components"
            yield (
                name,
                size,
                made.nbytes / 1e3,
                score(channel, value, values),
                float(100 * found.known.double().mean()),
                auc(made, test, CELL[name]),
                f"{seconds:.2f} ({plain:.2f})",
                sent(made),
            )
            if budget is not None:
                yield from grid_rows(name, channel, train, made.nbytes, points, values)
        given = known_points(train, channel)
        value, known, n, n_bytes = grid(*given, CELL[name], points)
        about = f"grid of {CELL[name]:g} m, {n:,} cells"
        yield name, about, n_bytes / 1e3, score(channel, value, values), share(known), None, None, None
        if channel == "colour":
            value, values, known = neighbours(scans)
            about = "frames before and after"
            yield name, about, None, score(channel, value, values), share(known), None, None, None


def share(known: Tensor) -> float:
    return 100 * float(known.double().mean())


def grid_rows(
    name: str, channel: str, train: Sequence[Scan], n_bytes: int, points: Tensor, values: Tensor
) -> Iterator[Row]:
    """The finest grid, and the finest octree, that take at most so many bytes."""
    given = known_points(train, channel)
    for kind, step in (("grid", 0), ("octree", STEP))[: 1 if channel == "class" else 2]:
        side = CELL[name] / 2
        while True:
            value, known, n, taken = grid(*given, side, points, step)
            if taken <= n_bytes:
                break
            side *= max(1.01, (taken / n_bytes) ** 0.4)
        about = f"{kind} of {side:.3f} m, {n:,} cells"
        yield name, about, taken / 1e3, score(channel, value, values), share(known), None, None, None


def neighbours(scans: Sequence[Scan]) -> tuple[Tensor, Tensor, Tensor]:
    """Colours by the nearest points of the frames beside held-out ones, true ones, and which are known."""
    found, true, known = [], [], []
    for i in range(EVERY, len(scans) - 1, EVERY):
        points, values = known_points(scans[i : i + 1], "colour")
        near, given = known_points([scans[i - 1], scans[i + 1]], "colour")
        distance, rows = cKDTree(near.numpy()).query(points.numpy(), 8, distance_upper_bound=0.03)
        seen = torch.from_numpy(np.isfinite(distance[:, -1]))
        found.append(given[torch.from_numpy(rows)[seen]].double().mean(1))
        true.append(values[seen])
        known.append(seen)
    return torch.cat(found), torch.cat(true), torch.cat(known)


COLUMNS = {"data": "", "from": "", "kB": ",.1f", "result": "", "known (%)": ".1f", "AUC": ".4f", "CPU s": ""}
COLUMNS |= {"sent": ""}
CASE = Case(
    "attributes",
    measure,
    "Result: PSNR of colours; share of right classes; correlation and RMS error of the intensity. CPU s of "
    "learning, and bytes for each component in datagrams; in brackets without attributes.",
    COLUMNS,
    ("kinect", "building", "courtyard"),
    key=2,
)

if __name__ == "__main__":
    run(__doc__, CASE)
