"""Two scans laid over each other: mixtures against Open3D's ICP, by start, error, time and bytes.

    OMP_NUM_THREADS=1 python benchmarks/registration.py --data FOLDER [--draws 1] [--only registration-hall]

FOLDER holds hall/ (single scans of a spinning lidar, some 5 m apart) and courtyard/ (five frames of a
narrow one each, some 5 m apart). All methods get the same clouds and the same starts: the true pose,
shifted and turned about the sensor in a direction at random. ICP narrows its correspondences from 3 m to
1 m to 0.3 m. What is sent is one of the two: points at 12 B, or the encoded mixture. Seconds are of the
processor, all threads together; what is prepared once for each cloud (normals; the mixture) is a column of
its own.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import open3d as o3d
import torch
from torch import Tensor

from gmmtorch import WindowedRule
from gmmtorch.experiments.harness import Case, Row, cpu_seconds, recording, run
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


def measure(name: str, options: Any) -> Iterator[Row]:
    scans = recording(options.data, name)
    clouds = [[cloud(scans, i, FRAMES[name]) for i in pair] for pair in PAIRS[name]]
    apart = [float((source.origin - target.origin).norm()) for target, source in clouds]
    options.about = (
        f"{len(clouds)} pairs, sensors {min(apart):.1f} to {max(apart):.1f} m apart; "
        f"Open3D {o3d.__version__}. Mixtures without a pose, from 12 headings: {unknown(clouds)}."
    )
    for label in options.methods:
        yield row(label, METHODS[label], clouds, options.draws)


def row(label: str, method: Method, clouds: list[list[Cloud]], n_draws: int) -> Row:
    """Successes of each start; medians of the errors of successes, of seconds and of bytes."""
    preparing, made = cpu_seconds(lambda: [[method.prepare(one) for one in pair] for pair in clouds])
    cells, good, seconds = [], [], []
    for metres, degrees in STARTS:
        generator = torch.Generator().manual_seed(0)
        n_good = 0
        for (_, source), ((reference, _), (moved, _)) in zip(clouds, made, strict=True):
            for _ in range(n_draws):
                start = perturbation(source.origin, metres, degrees, generator)
                spent, found = cpu_seconds(partial(method.align, moved, reference, start))
                seconds.append(spent)
                errors = error(found, source.origin)
                if errors[0] < SUCCESS[0] and errors[1] < SUCCESS[1]:
                    n_good += 1
                    good.append(errors)
        cells.append(f"{n_good}/{n_draws * len(clouds)}")
    middle = [statistics.median(column) for column in zip(*good, strict=True)] if good else []
    n_bytes = statistics.median(size for pair in made for _, size in pair)
    errors = middle if good else ["–", "–"]
    return label, *cells, *errors, preparing / (2 * len(clouds)), statistics.median(seconds), n_bytes


def unknown(clouds: list[list[Cloud]]) -> str:
    """Successes of mixtures in frames of their own, from twelve headings; and which were called reliable."""
    n_good = n_reliable = n_wrong = 0
    seconds = 0.0
    for target, source in clouds:
        (reference, _), (moved, _) = (METHODS["mixtures"].prepare(one) for one in (target, source))
        spent, found = cpu_seconds(
            lambda moved=moved, reference=reference: register(
                moved, reference, yaw_starts(moved, reference, 12)
            )
        )
        seconds += spent / len(clouds)
        metres, degrees = error(found.transform, source.origin)
        good = metres < SUCCESS[0] and degrees < SUCCESS[1]
        n_good += good
        n_reliable += found.reliable
        n_wrong += found.reliable and not good
    return (
        f"{n_good}/{len(clouds)} found, {n_reliable} called reliable, {n_wrong} of them wrong; "
        f"{seconds:.1f} s each"
    )


COLUMNS = {"": "", **dict.fromkeys((f"{metres:g} m, {degrees:g}°" for metres, degrees in STARTS), "")}
COLUMNS |= {"error (m)": ".3f", "(°)": ".2f", "prepare (s)": ".2f", "align (s)": ".2f", "bytes": ",.0f"}
ABOUT = "Results within 0.2 m and 2° of the truth, and median errors of those. CPU seconds, medians."
CASES = [
    Case(f"registration-{name}", partial(measure, name), ABOUT, COLUMNS, methods=tuple(METHODS))
    for name in PAIRS
]

if __name__ == "__main__":
    run(__doc__, *CASES, draws={"type": int, "default": 1, "help": "directions of each start"})
