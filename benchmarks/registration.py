"""Two scans laid over each other: mixtures against Open3D's ICP, by start, error, time and bytes.

    OMP_NUM_THREADS=1 python benchmarks/registration.py --data FOLDER [--draws 1] [--names hall courtyard]

FOLDER holds hall/ (single scans of a spinning lidar, some 5 m apart) and courtyard/ (five frames of a
narrow one each, some 5 m apart). All methods get the same clouds and the same starts: the true pose,
shifted and turned about the sensor in a direction at random. ICP narrows its correspondences from 3 m to
1 m to 0.3 m. What is sent is one of the two: points at 12 B, or the encoded mixture. Seconds are of the
processor, all threads together; what is prepared once for each cloud (normals; the mixture) is a column of
its own. Prints Markdown tables.
"""

from __future__ import annotations

import argparse
import math
import statistics
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from tables import hardware, markdown, publish
from torch import Tensor

from gmmtorch import WindowedRule, datasets
from gmmtorch.localization.registration import register, yaw_starts
from gmmtorch.mapping.codec import component_batch as codec
from gmmtorch.mapping.learning.windows import learn_window
from gmmtorch.pose import generators
from gmmtorch.scan import Scan

STARTS = ((0.1, 2.0), (0.5, 10.0), (1.0, 20.0), (2.0, 45.0))  # metres, degrees
SUCCESS = 0.2, 2.0  # metres, degrees at most
PAIRS = {
    "hall": [(10, 14), (20, 23), (30, 36)],
    "courtyard": [(0, 12), (40, 52), (80, 92)],
}
FRAMES = {"hall": 1, "courtyard": 5}
RULE = WindowedRule(noise=0.02, length=0.6)
VOXEL = 0.2
RANGES = (3.0, 1.0, 0.3)  # of correspondences, metres


class Cloud(NamedTuple):
    """Scans in the world frame, and where the sensor was."""

    scans: list[Scan]
    origin: Tensor


class Method(NamedTuple):
    """prepare: what is made once of a cloud, and the bytes sent of it; align: the pose from a start."""

    prepare: Callable[[Cloud], tuple[Any, int]]
    align: Callable[[Any, Any, Tensor], Tensor]


def ours(**options: Any) -> Method:
    def prepare(cloud: Cloud) -> tuple[Any, int]:
        sent = codec.encode(learn_window(cloud.scans, RULE, torch.Generator().manual_seed(0)))
        return codec.decode(sent), len(sent)

    def align(source: Any, target: Any, start: Tensor) -> Tensor:
        return register(source, target, start, **options).transform

    return Method(prepare, align)


def icp(voxel: float | None, planes: bool) -> Method:
    kind = o3d.pipelines.registration
    estimation = (
        kind.TransformationEstimationPointToPlane if planes else kind.TransformationEstimationPointToPoint
    )

    def prepare(cloud: Cloud) -> tuple[Any, int]:
        points = torch.cat([scan.points for scan in cloud.scans]).numpy()
        made = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
        made = made.voxel_down_sample(voxel) if voxel else made
        if planes:
            made.estimate_normals(o3d.geometry.KDTreeSearchParamHybrid(radius=1.0, max_nn=30))
        return made, 12 * len(made.points)

    def align(source: Any, target: Any, start: Tensor) -> Tensor:
        pose = start.numpy()
        for reach in RANGES:
            found = kind.registration_icp(
                source, target, reach, pose, estimation(), kind.ICPConvergenceCriteria(max_iteration=50)
            )
            pose = found.transformation
        return torch.from_numpy(np.array(pose))

    return Method(prepare, align)


METHODS = {
    "mixtures": ours(),
    "mixtures, `coarsest=0.25`": ours(coarsest=0.25),
    "mixtures, `weighting=support`": ours(weighting="support"),
    "ICP, point to point": icp(None, False),
    "ICP, point to plane": icp(None, True),
    f"point to point, voxels of {VOXEL:g} m": icp(VOXEL, False),
    f"point to plane, voxels of {VOXEL:g} m": icp(VOXEL, True),
}


def perturbation(about: Tensor, metres: float, degrees: float, generator: torch.Generator) -> Tensor:
    """A shift and a turn about a point (3,), both in directions at random."""
    shift, axis = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    turn = torch.linalg.matrix_exp(
        torch.einsum("k,kij->ij", axis / axis.norm() * math.radians(degrees), generators(3))
    )
    made = torch.eye(4, dtype=torch.float64)
    made[:3, :3], made[:3, 3] = turn, about - turn @ about + metres * shift / shift.norm()
    return made


def error(transform: Tensor, at: Tensor) -> tuple[float, float]:
    """Metres at a point and degrees from the truth: the identity, since clouds are in the world frame."""
    moved = transform[:3, :3] @ at + transform[:3, 3] - at
    skew = torch.linalg.matrix_norm(transform[:3, :3] - torch.eye(3, dtype=torch.float64))
    return float(moved.norm()), math.degrees(2 * math.asin(min(1.0, float(skew) / math.sqrt(8))))


def cloud(scans: Sequence[Scan], first: int, n: int) -> Cloud:
    chosen = [scans[i] for i in range(first, first + n)]
    return Cloud(chosen, chosen[n // 2].origin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--draws", type=int, default=1, help="directions of each start")
    parser.add_argument("--names", nargs="+", default=list(PAIRS), choices=list(PAIRS))
    options = parser.parse_args()
    torch.set_num_threads(1)
    print(f"{hardware()}; Open3D {o3d.__version__}")
    for name in options.names:
        pairs = PAIRS[name]
        scans = datasets.load("scan_folder", options.data / name)
        clouds = [[cloud(scans, i, FRAMES[name]) for i in pair] for pair in pairs]
        apart = [float((source.origin - target.origin).norm()) for target, source in clouds]
        print(f"\n{name}: {len(pairs)} pairs, sensors {min(apart):.1f} to {max(apart):.1f} m apart\n")
        header = [
            "",
            *(f"{m:g} m, {d:g}°" for m, d in STARTS),
            "error (m)",
            "(°)",
            "prepare (s)",
            "align (s)",
            "bytes",
        ]
        rows = []
        for label, method in METHODS.items():
            rows.append(row(label, method, clouds, options.draws))
            print(*rows[-1], sep=" | ", flush=True)
        publish(f"registration-{name}", markdown(header, rows))
        print(f"\nmixtures, unknown pose, 12 headings: {unknown(clouds)}")


def row(label: str, method: Method, clouds: list[list[Cloud]], n_draws: int) -> list[object]:
    """Successes of each start; medians of the errors of successes, of seconds and of bytes."""
    begin = time.process_time()
    made = [[method.prepare(one) for one in pair] for pair in clouds]
    preparing = (time.process_time() - begin) / (2 * len(clouds))
    cells, good, seconds = [], [], []
    for metres, degrees in STARTS:
        generator = torch.Generator().manual_seed(0)
        n_good = 0
        for (_, source), ((reference, _), (moved, _)) in zip(clouds, made, strict=True):
            for _ in range(n_draws):
                start = perturbation(source.origin, metres, degrees, generator)
                begin = time.process_time()
                found = method.align(moved, reference, start)
                seconds.append(time.process_time() - begin)
                errors = error(found, source.origin)
                if errors[0] < SUCCESS[0] and errors[1] < SUCCESS[1]:
                    n_good += 1
                    good.append(errors)
        cells.append(f"{n_good}/{n_draws * len(clouds)}")
    middle = [statistics.median(column) for column in zip(*good, strict=True)] if good else [math.nan] * 2
    n_bytes = statistics.median(size for pair in made for _, size in pair)
    return [
        label,
        *cells,
        f"{middle[0]:.3f}" if good else "–",
        f"{middle[1]:.2f}" if good else "–",
        f"{preparing:.2f}",
        f"{statistics.median(seconds):.2f}",
        f"{n_bytes:,.0f}",
    ]


def unknown(clouds: list[list[Cloud]]) -> str:
    """Successes of mixtures in frames of their own, from twelve headings; and which were called reliable."""
    n_good = n_reliable = n_wrong = 0
    begin = time.process_time()
    for target, source in clouds:
        (reference, _), (moved, _) = (METHODS["mixtures"].prepare(one) for one in (target, source))
        found = register(moved, reference, yaw_starts(moved, reference, 12))
        metres, degrees = error(found.transform, source.origin)
        good = metres < SUCCESS[0] and degrees < SUCCESS[1]
        n_good += good
        n_reliable += found.reliable
        n_wrong += found.reliable and not good
    seconds = (time.process_time() - begin) / len(clouds)
    return (
        f"{n_good}/{len(clouds)} found, {n_reliable} called reliable, {n_wrong} of them wrong; "
        f"{seconds:.1f} s each, mixtures included"
    )


if __name__ == "__main__":
    main()
