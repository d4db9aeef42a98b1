"""How fast: an EM iteration beside scikit-learn's, ray casting, and a whole 3D pass by stage.

    python benchmarks/speed.py [--threads 1] [--hall FOLDER]

All in one process with the threads fixed; writes its tables into BENCHMARKS.md.
"""

from __future__ import annotations

import argparse
import gc
import resource
import statistics
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import torch
from sklearn.mixture import GaussianMixture as ScikitLearnMixture
from tables import hardware, markdown, publish
from threadpoolctl import threadpool_limits
from torch import Tensor

from gmmtorch import GaussianMap, datasets
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


def em_iteration(n: int = 100_000, k: int = 100, iterations: int = 10, repeats: int = 5) -> None:
    """Seconds an iteration, from the same start, over the same number of iterations."""
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
    rows = []
    for index, name in enumerate(("gmmtorch, float32 exponentials", "gmmtorch, float64", "scikit-learn")):
        times = [run[index][0] for run in runs]
        ratio = statistics.median(run[2][0] / run[index][0] for run in runs)
        seconds = f"{statistics.median(times) * 1e3:.0f} ({min(times) * 1e3:.0f}–{max(times) * 1e3:.0f})"
        rows.append([name, seconds, f"{ratio:.1f}", f"{runs[0][index][1]:.6f}"])
    header = ["", "ms an iteration, median (range)", "times faster", "mean log-likelihood"]
    publish("em", f"{hardware()}\n\n{markdown(header, rows)}")


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


def ray_casting(n_rays: int = 1_000_000, repeats: int = 3) -> None:
    """Visits a second of a million rays of about 5 m through cells of 0.1 and 0.2 m."""
    rows = []
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
        rates = [f"{visits / statistics.median(times) / 1e6:.0f}" for times in (cast, counted, blocks)]
        rows.append(
            [f"{dim}D", f"{resolution} m", f"{visits / 1e6:.0f} M", *rates, f"{memory.mebibytes:.0f} MiB"]
        )
    header = [
        "",
        "cell",
        "visits",
        "ray casting, M visits/s",
        "and counting, dense",
        "and counting, block-sparse",
        "peak memory above the rays",
    ]
    publish("rays", f"{n_rays:,} rays. {hardware()}\n\n{markdown(header, rows)}")


def hall_by_stage(folder: Path, resolution: float = 0.2) -> None:
    """One pass over every scan: reading, learning, sampling, casting."""
    dataset = datasets.load("scan_folder", folder)
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
    rows = [[name, f"{seconds:.2f}"] for name, seconds in stages.items()]
    rows.append(["read to answered", f"{total:.2f}"])
    facts = (
        f"{len(scans)} scans, {ends.shape[0]:,} points, {built.n_components:,} components, {resolution} m. "  # type: ignore[arg-type]
    )
    publish("hall", f"{facts}{hardware()}\n\n{markdown(['stage', 'seconds'], rows)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument(
        "--hall", type=Path, help="folder of the hall scans; left out, that table is not remade"
    )
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    with threadpool_limits(options.threads):
        em_iteration()
        ray_casting()
        if options.hall:
            hall_by_stage(options.hall)


if __name__ == "__main__":
    main()
