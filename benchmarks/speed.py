"""How fast: an EM iteration beside scikit-learn's, ray casting, and a whole 3D pass by stage.

    python benchmarks/speed.py --data FOLDER [--threads 1]

FOLDER holds hall/; `--only em rays` needs none. All in one process with the threads fixed.
"""

from __future__ import annotations

import gc
import resource
import statistics
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from harness import Case, Row, recording, run
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from torch import Tensor

from gmmtorch import GaussianMap
from gmmtorch.kernels.rays.ray_traversal import traverse
from gmmtorch.mapping.learning.rules import WindowedRule
from gmmtorch.mapping.learning.windows import learn_window
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.occupancy.evidence import Evidence
from gmmtorch.occupancy.forms.monte_carlo import sample_rays
from gmmtorch.occupancy.grid import VoxelGrid
from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence


def noisy_room(n: int, seed: int) -> Tensor:
    """Points (n, 3) on the walls, floor and ceiling of an 8 × 6 × 3 m room, with 1 cm noise."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([8.0, 6.0, 3.0], dtype=torch.float64)
    points = torch.rand(n, 3, generator=generator, dtype=torch.float64) * size
    axis = torch.multinomial(torch.tensor([18.0, 24.0, 48.0]), n, True, generator=generator)
    side = torch.randint(2, (n,), generator=generator)
    points[torch.arange(n), axis] = side * size[axis]
    return points + 0.01 * torch.randn(n, 3, generator=generator, dtype=torch.float64)


def timed(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def em_iteration(options: Any) -> Iterator[Row]:
    """Seconds an iteration, from the same start, over the same number of iterations."""
    n, k, iterations, repeats = 100_000, 100, 10, 5
    points = noisy_room(n, seed=1)
    means = points[torch.randperm(n, generator=torch.Generator().manual_seed(2))[:k]]
    covariances = 0.25 * torch.eye(3, dtype=torch.float64).expand(k, 3, 3)
    weights = torch.full((k,), 1 / k, dtype=torch.float64)

    def ours(dtype: torch.dtype) -> tuple[float, float]:
        center = points.mean(0)
        step = loop.natural_step(em.quadratic_features(points - center), torch.ones(n).double(), 1e-6, dtype)
        state = em.Parameters(weights, means - center, covariances)
        begin = time.perf_counter()
        found = loop.run_em(step, state, tol=0, max_iter=iterations)
        return (time.perf_counter() - begin) / iterations, found.lower_bounds[-1]

    def theirs() -> tuple[float, float]:
        def run(max_iter: int) -> tuple[float, ScikitLearnMixture]:
            peer = ScikitLearnMixture(
                k,
                tol=0,
                max_iter=max_iter,
                weights_init=weights.numpy(),
                means_init=means.numpy(),
                precisions_init=torch.linalg.inv(covariances).numpy(),
                init_params="random_from_data",
                random_state=0,
            )
            return timed(lambda: peer.fit(points.numpy())), peer

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            short, long = run(1)[0], run(iterations + 1)[0]
            bound = run(iterations)[1].lower_bounds_[-1]
        # What is not iteration (start, last E-step) is in both, and drops out.
        return (long - short) / iterations, float(bound)

    # Turn about, so that a change of the machine's speed meets all alike.
    runs = [(ours(torch.float32), ours(torch.float64), theirs()) for _ in range(repeats)]
    for index, name in enumerate(("gmmtorch, float32 exponentials", "gmmtorch, float64", "scikit-learn")):
        times = [1e3 * run[index][0] for run in runs]
        yield {
            "": name,
            "ms an iteration, median (range)": (
                f"{statistics.median(times):.0f} ({min(times):.0f}–{max(times):.0f})"
            ),
            "times faster": statistics.median(run[2][0] / run[index][0] for run in runs),
            "mean log-likelihood": runs[0][index][1],
        }


class PeakMemory:
    """Largest resident size of this process, above what it was before, sampled every 5 ms."""

    def __enter__(self) -> PeakMemory:
        gc.collect()
        self.peak = self._before = self._resident()
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    def _watch(self) -> None:
        while not self._done.wait(0.005):
            self.peak = max(self.peak, self._resident())

    @staticmethod
    def _resident() -> int:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
        return pages * resource.getpagesize()

    @property
    def mebibytes(self) -> float:
        return (self.peak - self._before) / 2**20


def ray_casting(options: Any) -> Iterator[Row]:
    """Visits a second of rays of about 5 m."""
    n_rays, repeats = options.rays, 3
    options.about = f"{n_rays:,} rays."
    for dim, resolution in ((2, 0.1), (2, 0.02), (3, 0.2), (3, 0.05)):
        generator = torch.Generator().manual_seed(0)
        extent = torch.tensor([20.0, 20.0, 4.0][:dim], dtype=torch.float64)
        starts = torch.rand(n_rays, dim, generator=generator, dtype=torch.float64) * extent
        ends = starts + torch.randn(n_rays, dim, generator=generator, dtype=torch.float64) * 3
        ends = ends.clamp(torch.full((dim,), 1e-6, dtype=torch.float64), extent - 1e-6)
        grid = VoxelGrid((0.0,) * dim, resolution, tuple(round(float(x) / resolution) for x in extent))
        a, b = grid.to_units(starts), grid.to_units(ends)
        visits = sum(chunk.voxel.numel() for chunk in traverse(a, b, grid.shape))
        cast, counted, blocks = [], [], []
        with PeakMemory() as memory:
            for _ in range(repeats):
                cast.append(timed(lambda: sum(1 for _ in traverse(a, b, grid.shape))))  # noqa: B023
                counted.append(timed(lambda: Evidence.empty(grid).add_rays(starts, ends)))  # noqa: B023
                blocks.append(timed(lambda: SparseEvidence(resolution, dim).add_rays(starts, ends)))  # noqa: B023
        label: Row = {"": f"{dim}D", "cell": f"{resolution} m", "visits": visits / 1e6}
        times = {
            "ray casting, M visits/s": cast,
            "and counting, dense": counted,
            "and counting, block-sparse": blocks,
        }
        rates = {name: visits / statistics.median(seconds) / 1e6 for name, seconds in times.items()}
        yield {**label, **rates, "peak memory above the rays": memory.mebibytes}


def hall_by_stage(options: Any) -> Iterator[Row]:
    """One pass over every scan: reading, learning, sampling, casting."""
    dataset, resolution = recording(options.data, "hall"), 0.2
    stages: dict[str, float] = {}

    def stage(name: str, work: Callable[[], object]) -> object:
        begin = time.perf_counter()
        result = work()
        stages[name] = time.perf_counter() - begin
        return result

    scans = stage("read scans", lambda: list(dataset))
    rule, generator = WindowedRule(), torch.Generator().manual_seed(0)
    windows = [scans[i : i + 20] for i in range(0, len(scans), 20)]  # type: ignore[index,arg-type]
    stage("learn windows of 20 scans", lambda: [learn_window(w, rule, generator) for w in windows])
    built = GaussianMap()
    stage("the same through GaussianMap.insert", lambda: [built.insert(s) for s in scans] and built.finish())  # type: ignore[attr-defined,func-returns-value]
    cones = built.components().cones()
    rays = stage("sample 10⁶ rays (Sobol)", lambda: sample_rays(cones, 1_000_000, generator))
    evidence = SparseEvidence(resolution, 3)
    stage("cast them, block-sparse", lambda: evidence.add_rays(*rays))  # type: ignore[misc]
    centers = evidence.bounds()[0] + torch.rand(1_000_000, 3).double() * 20
    stage("ask 10⁶ points", lambda: evidence.lookup(centers))
    raw = SparseEvidence(resolution, 3)
    ends = torch.cat([s.points for s in scans])  # type: ignore[attr-defined]
    origins = torch.cat([s.origin.expand_as(s.points) for s in scans])  # type: ignore[attr-defined]
    stage("for comparison: cast every raw beam", lambda: raw.add_rays(origins, ends))
    total = sum(seconds for name, seconds in stages.items() if not name.startswith(("for", "the same")))
    n_scans, n_points = len(scans), ends.shape[0]  # type: ignore[arg-type]
    options.about = (
        f"{n_scans} scans, {n_points:,} points, {built.n_components:,} components, {resolution} m."
    )
    for name, seconds in {**stages, "read to answered": total}.items():
        yield {"stage": name, "seconds": seconds}


RATES = ("ray casting, M visits/s", "and counting, dense", "and counting, block-sparse")
RAYS = {"visits": "{:.0f} M", **dict.fromkeys(RATES, ".0f"), "peak memory above the rays": "{:.0f} MiB"}
CASES = (
    Case(
        "em",
        em_iteration,
        "100,000 points on the surfaces of a room, 1 cm noise, 100 components; ten iterations from the same "
        "parameters.",
        {"times faster": ".1f", "mean log-likelihood": ".6f"},
        needs_data=False,
    ),
    Case("rays", ray_casting, formats=RAYS, key=2, needs_data=False),
    Case("hall", hall_by_stage, formats={"seconds": ".2f"}),
)

if __name__ == "__main__":
    run(__doc__, *CASES, rays={"type": int, "default": 1_000_000})
