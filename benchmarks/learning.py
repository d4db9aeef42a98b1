"""Learning a mixture, beside scikit-learn, tgmm and torchgmm: seconds at equal quality.

    pip install 'gmmtorch[benchmarks]'
    python benchmarks/learning.py --data FOLDER [--threads 1] [--only CASE …] [--methods METHOD …]

FOLDER holds hall/ and kinect/. All methods see the same clouds, drawn with other seeds than the
warm-up's. Every run is kept in outputs/learning-THREADS.jsonl; the table written into BENCHMARKS.md has
the last of each case and method there, so that parts can be run again.
"""

from __future__ import annotations

import argparse
import json
import logging
import multiprocessing
import resource
import statistics
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import torch
from speed import noisy_room
from tables import OUTPUTS, hardware, markdown, publish
from threadpoolctl import threadpool_limits
from torch import Tensor

from gmmtorch import GaussianMixture, HierarchicalGaussianMixture, datasets
from gmmtorch.experiments.evaluation.metrics import psnr2

REG_COVAR = 1e-5
TIME_LIMIT = 240  # seconds of the processor, for one run


class Case(NamedTuple):
    """K components for a cloud (of a seed), and how it is asked of ours: options, repeats."""

    n_components: int
    cloud: Callable[[int], tuple[Tensor, Tensor, Tensor | None]]  # → train, held out, fresh
    tol: float
    peers: tuple[str, ...]


def room(n: int) -> Callable[[int], tuple[Tensor, Tensor, Tensor | None]]:
    return lambda seed: (noisy_room(n, seed), noisy_room(20_000, 1000 + seed), noisy_room(n, 2000 + seed))


def scan(name: str, folder: Path, stride: int = 1) -> Callable[[int], tuple[Tensor, Tensor, Tensor | None]]:
    """Scan number `seed` of a data set; every tenth of its points is held out."""

    def cloud(seed: int) -> tuple[Tensor, Tensor, Tensor | None]:
        points = datasets.load(name, folder)[seed % 40].points[::stride].double()
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
    from sklearn.mixture import GaussianMixture as Peer

    peer = Peer(k, tol=1e-3, reg_covar=REG_COVAR, random_state=0).fit(points.numpy())
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


def measured(name: str, case: Case, seed: int, warm: int) -> dict[str, Any]:
    """One run of a method: seconds, and how good its mixture is."""
    method, k = METHODS[name], case.n_components
    train, held_out, _ = case.cloud(seed)
    if name.startswith("gmmtorch"):
        method(case.cloud(warm)[0], k, case.tol)
    # Other programs on the machine do not add to the processor's seconds of one thread.
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    begin = clock()
    found = method(train, k, case.tol)
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


def _child(name: str, case_name: str, folder: str, seed: int, warm: int, threads: int, pipe: Any) -> None:
    warnings.simplefilter("ignore")
    resource.setrlimit(resource.RLIMIT_CPU, (threads * TIME_LIMIT, threads * TIME_LIMIT))
    torch.set_num_threads(threads)
    with threadpool_limits(threads):
        try:
            pipe.send(measured(name, cases(Path(folder))[case_name], seed, warm))
        except Exception as error:  # a peer's failure is a result, and is published
            pipe.send({"error": f"{type(error).__name__}: {str(error).splitlines()[0][:60]}"})


def in_process(name: str, case_name: str, folder: Path, seed: int, threads: int) -> dict[str, Any]:
    """The same in a process of its own, which is stopped at the time limit."""
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    arguments = (name, case_name, str(folder), seed, seed + 500, threads, there)
    process = context.Process(target=_child, args=arguments)
    process.start()
    there.close()
    try:
        found = here.recv()
    except EOFError:  # the system has ended it
        found = {"error": f"over {TIME_LIMIT} s"}
    process.join()
    return dict(found)


def cases(folder: Path) -> dict[str, Case]:
    every = ("scikit-learn", "tgmm", "torchgmm")
    return {
        "room, 20k points, K = 1000": Case(1000, room(20_000), 5e-3, every),
        "room, 100k points, K = 64": Case(64, room(100_000), 1.5e-3, every),
        "room, 100k points, K = 1000": Case(1000, room(100_000), 2e-3, ()),
        "a hall scan, K = 256": Case(256, scan("scan_folder", folder / "hall"), 2e-3, every),
        "a kinect frame, K = 50": Case(50, scan("depth_frames", folder / "kinect", 3), 2e-3, every),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="cases whose names contain one of these")
    parser.add_argument("--repeats", type=int, default=3, help="clouds for ours; peers see the first")
    parser.add_argument("--methods", nargs="*", help="methods of these names only")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    log = OUTPUTS / f"learning-{options.threads}.jsonl"
    every = cases(options.data)
    seed = 11
    for case_name, case in every.items():
        if options.only and not any(part in case_name for part in options.only):
            continue
        for name in METHODS:
            is_peer = not name.startswith("gmmtorch")
            if (is_peer and name not in case.peers) or (options.methods and name not in options.methods):
                continue
            repeats = options.repeats if name in ("gmmtorch", "gmmtorch, hierarchical") else 1
            runs = [
                in_process(name, case_name, options.data, seed + i, options.threads) for i in range(repeats)
            ]
            print(case_name, name, runs, flush=True)
            with log.open("a") as file:
                file.write(json.dumps({"case": case_name, "method": name, "runs": runs}) + "\n")
    kept = {}
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        kept[entry["case"], entry["method"]] = entry["runs"]
    rows = []
    for case_name, case in every.items():
        runs_of = {name: kept[case_name, name] for name in METHODS if (case_name, name) in kept}
        rows += table(case_name, runs_of)
        train, _, fresh = case.cloud(seed)
        if fresh is not None and runs_of:
            ceiling = f"{psnr2(train, fresh):.1f}"
            rows.append([case_name, "(a fresh sample of the room)", "", "", "", "", "", ceiling])
    header = ["", "method", "seconds", "times faster", "iterations, tol", "K", "held-out nats", "PSNR2 dB"]
    mark = f"learning-{options.threads}"
    publish(mark, f"{hardware()}\n\n{markdown(header, rows)}")


def table(case_name: str, runs: dict[str, list[dict[str, Any]]]) -> list[list[str]]:
    """A row for each method: seconds are medians, quality is on the first cloud, which all methods saw."""
    reference = runs.get("scikit-learn", [{}])[0].get("seconds")
    rows = []
    for name, found in runs.items():
        if "error" in found[0]:
            rows.append([case_name, name, found[0]["error"], "", "", "", "", ""])
            continue
        first = found[0]
        seconds = statistics.median(run["seconds"] for run in found)
        ratio = f"{reference / seconds:.0f}" if reference and seconds < reference else ""
        rows.append(
            [
                case_name,
                name,
                f"{seconds:.2f}",
                ratio,
                f"{first['iterations']}, {first['tol']}",
                f"{first['k']}",
                f"{first['held_out']:.4f}",
                f"{first['psnr2']:.2f}",
            ]
        )
    return rows


if __name__ == "__main__":
    main()
