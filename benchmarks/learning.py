"""Learning a mixture, beside scikit-learn, tgmm and torchgmm: seconds at equal quality.

    pip install 'gmmtorch[benchmarks]'
    python benchmarks/learning.py --data FOLDER [--threads 1] [--names CLOUD …] [--methods METHOD …]
    python benchmarks/learning.py --only em ten-million

FOLDER holds hall/ and kinect/. All methods see the same clouds, drawn with other seeds than the warm-up's.
`em` has one iteration of EM. `ten-million` has ten million points and ten thousand components.
"""

from __future__ import annotations

import logging
import resource
import statistics
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import sklearn.mixture
import torch
from torch import Tensor

from gmmtorch import GaussianMixture, HierarchicalGaussianMixture
from gmmtorch.experiments.evaluation.metrics import psnr2
from gmmtorch.experiments.harness import Case, Row, alone, clock, cpu_seconds, least_seconds, recording, run
from gmmtorch.mixture.em import exact as em
from gmmtorch.mixture.em import loop
from gmmtorch.mixture.em.truncated import Rows

REG_COVAR = 1e-5
TIME_LIMIT = 240  # seconds of the processor, for one run


class Cloud(NamedTuple):
    """K components for a cloud, and the tolerance of ours.

    drawn: (folder, seed) → train, held out, and a fresh sample if there is one.
    """

    n_components: int
    drawn: Callable[[Path, int], tuple[Tensor, Tensor, Tensor | None]]
    tol: float
    peers: tuple[str, ...] = ("scikit-learn", "tgmm", "torchgmm")


def noisy_room(n: int, seed: int) -> Tensor:
    """Points (n, 3) on the walls, floor and ceiling of an 8 × 6 × 3 m room, with 1 cm noise."""
    generator = torch.Generator().manual_seed(seed)
    size = torch.tensor([8.0, 6.0, 3.0], dtype=torch.float64)
    points = torch.rand(n, 3, generator=generator, dtype=torch.float64) * size
    axis = torch.multinomial(torch.tensor([18.0, 24.0, 48.0]), n, True, generator=generator)
    side = torch.randint(2, (n,), generator=generator)
    points[torch.arange(n), axis] = side * size[axis]
    return points + 0.01 * torch.randn(n, 3, generator=generator, dtype=torch.float64)


def room(n: int) -> Callable[[Path, int], tuple[Tensor, Tensor, Tensor | None]]:
    return lambda _, seed: (noisy_room(n, seed), noisy_room(20_000, 1000 + seed), noisy_room(n, 2000 + seed))


def scan(name: str, stride: int = 1) -> Callable[[Path, int], tuple[Tensor, Tensor, Tensor | None]]:
    """Scan number `seed` of a data set; every tenth of its points is held out."""

    def cloud(folder: Path, seed: int) -> tuple[Tensor, Tensor, Tensor | None]:
        points = recording(folder, name)[seed % 40].points[::stride].double()
        shuffled = points[torch.randperm(len(points), generator=torch.Generator().manual_seed(seed))]
        n_test = len(points) // 10
        return shuffled[n_test:], shuffled[:n_test], None

    return cloud


class Learned(NamedTuple):
    weights: Tensor
    means: Tensor
    covariances: Tensor
    n_iter: int
    tol: str


def ours(points: Tensor, k: int, tol: float) -> Learned:
    found = GaussianMixture(k, tol=tol, reg_covar=REG_COVAR, random_state=0).fit(points)
    return Learned(found.weights, found.means, found.covariances, found.n_iter_, f"{tol:g}")


def ours_exact(points: Tensor, k: int, tol: float) -> Learned:
    options: dict[str, Any] = {"algorithm": "exact", "init_params": "kmeans"}
    found = GaussianMixture(k, tol=1e-3, reg_covar=REG_COVAR, random_state=0, **options).fit(points)
    return Learned(found.weights, found.means, found.covariances, found.n_iter_, "0.001")


def ours_from_kmeans(points: Tensor, k: int, tol: float) -> Learned:
    options: dict[str, Any] = {"algorithm": "truncated", "init_params": "kmeans"}
    found = GaussianMixture(k, tol=tol, reg_covar=REG_COVAR, random_state=0, **options).fit(points)
    return Learned(found.weights, found.means, found.covariances, found.n_iter_, f"{tol:g}")


def ours_tree(points: Tensor, k: int, tol: float) -> Learned:
    found = HierarchicalGaussianMixture(k, reg_covar=REG_COVAR, random_state=0).fit(points)
    return Learned(found.weights, found.means, found.covariances, found.n_iter_, f"{found.tol:g}")


def scikit_learn(points: Tensor, k: int, tol: float) -> Learned:
    options: dict[str, Any] = {"tol": 1e-3, "reg_covar": REG_COVAR, "random_state": 0}
    peer = sklearn.mixture.GaussianMixture(k, **options).fit(points.numpy())
    weights, means, covariances = (
        torch.from_numpy(x) for x in (peer.weights_, peer.means_, peer.covariances_)
    )
    return Learned(weights, means, covariances, peer.n_iter_, "0.001")


def tgmm(points: Tensor, k: int, tol: float) -> Learned:
    """Its tolerance is relative to the log-likelihood, which is about 2 nats a point here."""
    import tgmm as package

    peer = package.GaussianMixture(
        k, n_features=3, tol=5e-4, max_iter=100, reg_covar=REG_COVAR, random_state=0
    )
    peer.fit(points)
    return Learned(peer.weights_, peer.means_, peer.covariances_, peer.n_iter_, "0.0005 relative")


def torchgmm(points: Tensor, k: int, tol: float) -> Learned:
    from torchgmm.bayes import GaussianMixture as Peer

    for name in ("pytorch_lightning", "lightning", "lightning.pytorch"):
        logging.getLogger(name).setLevel(logging.ERROR)
    quiet = dict.fromkeys(
        ("enable_progress_bar", "logger", "enable_checkpointing", "enable_model_summary"), False
    )
    peer = Peer(
        k,
        covariance_type="full",
        convergence_tolerance=1e-3,
        covariance_regularization=REG_COVAR,
        trainer_params={"max_epochs": 100, "accelerator": "cpu", **quiet},
    )
    torch.manual_seed(0)
    peer.fit(points.float())
    model = peer.model_
    return Learned(
        model.component_probs.double(),
        model.means.double(),
        model.covariances.double(),
        int(getattr(peer, "num_iter_", 0)),
        "0.001",
    )


METHODS = {
    "gmmtorch": ours,
    "gmmtorch, from k-means": ours_from_kmeans,
    "gmmtorch, exact EM from k-means": ours_exact,
    "gmmtorch, hierarchical": ours_tree,
    "scikit-learn": scikit_learn,
    "tgmm": tgmm,
    "torchgmm": torchgmm,
}


CLOUDS = {
    "room, 20k points, K = 1000": Cloud(1000, room(20_000), 5e-3),
    "room, 100k points, K = 64": Cloud(64, room(100_000), 1.5e-3),
    "room, 100k points, K = 1000": Cloud(1000, room(100_000), 2e-3, ()),
    "a hall scan, K = 256": Cloud(256, scan("hall"), 2e-3),
    "a kinect frame, K = 50": Cloud(50, scan("kinect", 3), 2e-3),
}
SEED, WARM = 11, 500  # of the first cloud; from a cloud's to its warm-up's


def measured(name: str, cloud_name: str, folder: Path, seed: int) -> dict[str, Any]:
    """One run of a method: seconds, and how good its mixture is."""
    warnings.simplefilter("ignore")
    method, cloud = METHODS[name], CLOUDS[cloud_name]
    train, held_out, _ = cloud.drawn(folder, seed)
    if name.startswith("gmmtorch"):
        method(cloud.drawn(folder, seed + WARM)[0], cloud.n_components, cloud.tol)
    begin = clock()
    found = method(train, cloud.n_components, cloud.tol)
    seconds = clock() - begin
    weights = found.weights.double() / found.weights.double().sum()
    mixture = GaussianMixture.from_parameters(weights, found.means, found.covariances, random_state=0)
    return {
        "seconds": seconds,
        "iterations": found.n_iter,
        "tol": found.tol,
        "k": len(weights),
        "held_out": mixture.score(held_out),
        "psnr2": psnr2(train, mixture.sample(train.shape[0])[0]),
    }


def measure(options: Any) -> Iterator[Row]:
    """Seconds of ours are medians over clouds; quality is on the first cloud, which all methods see."""
    for cloud_name in options.names:
        cloud, reference = CLOUDS[cloud_name], None
        for name in sorted(options.methods, key=lambda name: name != "scikit-learn"):
            if not name.startswith("gmmtorch") and name not in cloud.peers:
                continue
            repeats = options.repeats if name in ("gmmtorch", "gmmtorch, hierarchical") else 1
            runs = [
                alone(measured, name, cloud_name, options.data, SEED + i, limit=TIME_LIMIT)
                for i in range(repeats)
            ]
            if "error" in runs[0]:
                yield {"": cloud_name, "method": name, "seconds": runs[0]["error"]}
                continue
            first, seconds = runs[0], statistics.median(run["seconds"] for run in runs)
            reference = seconds if name == "scikit-learn" else reference
            yield {
                "": cloud_name,
                "method": name,
                "seconds": seconds,
                "times faster": reference / seconds if reference and seconds < reference else None,
                "iterations, tol": f"{first['iterations']}, {first['tol']}",
                "K": first["k"],
                "held-out nats": first["held_out"],
                "PSNR2 dB": first["psnr2"],
            }
        train, _, fresh = cloud.drawn(options.data, SEED)
        if fresh is not None:
            row = {"": cloud_name, "method": "(a fresh sample of the room)"}
            yield {**row, "PSNR2 dB": f"{psnr2(train, fresh):.1f}"}


def em_iteration(options: Any) -> Iterator[Row]:
    """Seconds an iteration, from the same start, over the same number of iterations."""
    n, k, iterations, repeats = 100_000, 100, 10, 5
    points = noisy_room(n, seed=1)
    means = points[torch.randperm(n, generator=torch.Generator().manual_seed(2))[:k]]
    covariances = 0.25 * torch.eye(3, dtype=torch.float64).expand(k, 3, 3)
    weights = torch.full((k,), 1 / k, dtype=torch.float64)

    def ours(dtype: torch.dtype) -> tuple[float, float]:
        center = points.mean(0)
        features = em.quadratic_features(points - center)
        step = loop.em_step(Rows(features, torch.ones(n).double(), are_points=False), 1e-6, dtype)
        state = em.Parameters(weights, means - center, covariances)
        begin = time.perf_counter()
        found = loop.run_em(step, state, tol=0, max_iter=iterations)
        return (time.perf_counter() - begin) / iterations, found.lower_bounds[-1]

    def theirs() -> tuple[float, float]:
        def run(max_iter: int) -> tuple[float, sklearn.mixture.GaussianMixture]:
            peer = sklearn.mixture.GaussianMixture(
                k,
                tol=0,
                max_iter=max_iter,
                weights_init=weights.numpy(),
                means_init=means.numpy(),
                precisions_init=torch.linalg.inv(covariances).numpy(),
                init_params="random_from_data",
                random_state=0,
            )
            return least_seconds(lambda: peer.fit(points.numpy()), 1), peer

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
        spent = f"{statistics.median(times):.0f} ({min(times):.0f}–{max(times):.0f})"
        ratio = statistics.median(run[2][0] / run[index][0] for run in runs)
        yield name, spent, ratio, runs[0][index][1]


def ten_million(options: Any) -> Iterator[Row]:
    """Fits that end on the points, and on cells."""
    parts = [noisy_room(1_000_000, seed).float() for seed in range(-(-options.points // 1_000_000))]
    points = torch.cat(parts)[: options.points]
    del parts
    held_out = noisy_room(20_000, 12345)
    options.about = f"{len(points):,} points, K = {options.components:,}."
    for name, max_cells in (("points", None), ("cells only", options.points // 16)):
        mixture = GaussianMixture(
            options.components, tol=2e-3, reg_covar=1e-5, max_cells=max_cells, random_state=0
        )
        seconds, _ = cpu_seconds(lambda mixture=mixture: mixture.fit(points))
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
        yield name, seconds, mixture.n_iter_, peak, mixture.score(held_out)


SCORES = {"held-out nats": ".4f", "PSNR2 dB": ".2f"}
PEAK = {"peak memory of the process": "{:.1f} GiB", "held-out nats": ".4f"}
CASES = (
    Case(
        "learning-{threads}",
        measure,
        "",
        {"seconds": ".2f", "times faster": ".0f", "K": ".0f", **SCORES},
        tuple(CLOUDS),
        tuple(METHODS),
        key=2,
    ),
    Case(
        "em",
        em_iteration,
        "100,000 points on the surfaces of a room, 1 cm noise, 100 components; ten iterations from the same "
        "parameters.",
        {
            "": "",
            "ms an iteration, median (range)": "",
            "times faster": ".1f",
            "mean log-likelihood": ".6f",
        },
        needs_data=False,
    ),
    Case(
        "ten-million",
        ten_million,
        columns={"EM ends on": "", "CPU s": ".0f", "iterations": ".0f", **PEAK},
        needs_data=False,
    ),
)

if __name__ == "__main__":
    run(
        __doc__,
        *CASES,
        repeats={"type": int, "default": 3, "help": "clouds for ours; peers see the first"},
        points={"type": int, "default": 10_000_000, "help": "of ten-million"},
        components={"type": int, "default": 10_000, "help": "of ten-million"},
    )
