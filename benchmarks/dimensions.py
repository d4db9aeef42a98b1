"""Mixtures in many dimensions, beside scikit-learn: seconds, peak memory and log-likelihoods.

    python benchmarks/dimensions.py [--threads 1] [--only TEXT …] [--most 6e10]

Both fit the same clouds from the same start for the same number of iterations; --most leaves out fits of
more products of N, K and D (full covariances: D²). Whole fits start as each package does by itself. Every
measurement is kept in outputs/dimensions-THREADS.jsonl; the table written into BENCHMARKS.md has the last
of each, so that parts can be run again.
"""

from __future__ import annotations

import argparse
import ctypes
import itertools
import json
import multiprocessing
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sklearn.mixture
import torch
from sklearn.datasets import load_digits, load_iris
from tables import OUTPUTS, hardware, markdown, publish
from threadpoolctl import threadpool_limits

import gmmtorch
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, type_shape

N_ITER = 3
SEED = 5


class Cell(NamedTuple):
    """N points in D dimensions, K components; `table`: of the package's own start, on this table."""

    kind: str
    n: int
    dim: int
    k: int
    table: str = ""

    def name(self) -> str:
        return f"{self.table or 'blobs'} {self.n} × {self.dim}, K = {self.k}, {self.kind}"

    def products(self) -> float:
        """Of an iteration; scikit-learn's tied covariances take as many as full ones."""
        return float(self.n) * self.k * self.dim ** (2 if self.kind in ("full", "tied") else 1)


def blobs(n: int, dim: int, k: int) -> np.ndarray:
    """A sample of K round components that overlap in few dimensions."""
    rng = np.random.default_rng(SEED)
    centers, own = rng.normal(size=(k, dim)) * 3 / dim**0.25, rng.integers(k, size=n)
    points: np.ndarray = centers[own] + rng.normal(size=(n, dim)) * (0.5 + rng.random((k, 1)))[own]
    return points


def one_hot(n: int, dim: int) -> np.ndarray:
    """Tables of categories: 40 columns with 2 to 12 values each."""
    rng = np.random.default_rng(SEED)
    sizes = rng.integers(2, 13, size=40)
    sizes[0] += dim - sizes.sum()
    return np.concatenate([np.eye(s)[rng.integers(s, size=n)] for s in sizes], 1)


TABLES: dict[str, Callable[[int, int], np.ndarray]] = {
    "one-hot": one_hot,
    "digits": lambda n, dim: np.asarray(load_digits().data),
    "iris": lambda n, dim: np.asarray(load_iris().data),
    "blobs, own start": lambda n, dim: blobs(n, dim, 16),
}


def cells(most: float) -> list[Cell]:
    every = itertools.product((2000, 50_000), (1, 2, 3, 8, 16, 64, 128, 384), (8, 64), COVARIANCE_TYPES)
    grid = [Cell(kind, n, dim, k) for n, dim, k, kind in every]
    own = [Cell("full", 1477, 284, 100, "one-hot"), Cell("diag", 50_000, 128, 16, "blobs, own start")]
    own += [Cell(kind, 1797, 64, 10, "digits") for kind in COVARIANCE_TYPES]
    own += [Cell(kind, 150, 4, 3, "iris") for kind in COVARIANCE_TYPES]
    return [cell for cell in grid + own if cell.products() <= most]


def start(points: np.ndarray, cell: Cell) -> dict[str, Any]:
    """Components at random points, with the cloud's mean variance."""
    rng = np.random.default_rng(SEED + 1)
    shape = type_shape(cell.kind, cell.k, cell.dim)
    precisions = np.full(shape, 1 / points.var(0).mean())
    if cell.kind in ("full", "tied"):
        precisions *= np.eye(cell.dim)
    means = points[rng.choice(cell.n, cell.k, replace=False)]
    return {
        "weights_init": np.full(cell.k, 1 / cell.k),
        "means_init": means,
        "precisions_init": precisions,
        "max_iter": N_ITER,
        "tol": 0,
    }


def status(name: str) -> float:
    """A size of this process in MB, from the system."""
    text = Path("/proc/self/status").read_text()
    return int(text.split(f"{name}:")[1].split()[0]) / 1000


def measured(ours: bool, cell: Cell) -> dict[str, Any]:
    """Seconds of the processor of a fit and of its score, the memory of the fit, and what it found."""
    points = TABLES[cell.table](cell.n, cell.dim) if cell.table else blobs(cell.n, cell.dim, cell.k)
    options: dict[str, Any] = {"covariance_type": cell.kind, "random_state": 0, "reg_covar": 1e-6}
    if not cell.table:
        options |= start(points, cell)
        options |= {"algorithm": "exact"} if ours else {}
    elif ours:
        options |= {"init_params": "kmeans"}
    made = gmmtorch.GaussianMixture if ours else sklearn.mixture.GaussianMixture
    seconds, scores, memory = [], [], []
    clock = time.process_time if torch.get_num_threads() == 1 else time.perf_counter
    for _ in range(5):
        ctypes.CDLL(None).malloc_trim(0)
        Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
        before = status("VmRSS")
        begin = clock()
        mixture = made(cell.k, **options).fit(points)
        seconds.append(clock() - begin)
        memory.append(status("VmHWM") - before)
        begin = clock()
        value = mixture.score(points)
        scores.append(clock() - begin)
        if sum(seconds) > 2:
            break
    return {
        "seconds": min(seconds),
        "score_seconds": min(scores),
        "megabytes": min(memory),
        "nats": value,
        "iterations": mixture.n_iter_,
    }


def _child(ours: bool, todo: list[Cell], threads: int, pipe: Any) -> None:
    warnings.simplefilter("ignore")
    torch.set_num_threads(threads)
    with threadpool_limits(threads):
        measured(ours, Cell("full", 2000, 3, 8))  # loads libraries and compiles
        for cell in todo:
            try:
                pipe.send(measured(ours, cell))
            except Exception as error:  # is a result, and is published
                pipe.send({"error": f"{type(error).__name__}: {str(error).splitlines()[0][:60]}"})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--only", nargs="*", help="cells whose names contain all of these")
    parser.add_argument("--most", type=float, default=2e10, help="products of a cell's iteration")
    parser.add_argument("--methods", nargs="*", default=["gmmtorch", "scikit-learn"])
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    log = OUTPUTS / f"dimensions-{options.threads}.jsonl"
    every = cells(options.most)
    todo = [cell for cell in every if all(part in cell.name() for part in options.only or ())]
    context = multiprocessing.get_context("spawn")
    pipes = {}
    for method in options.methods:
        here, there = context.Pipe()
        arguments = (method == "gmmtorch", todo, options.threads, there)
        context.Process(target=_child, args=arguments, daemon=True).start()
        there.close()
        pipes[method] = here
    for cell in todo:
        for method, pipe in pipes.items():
            found = pipe.recv()
            print(cell.name(), method, found, flush=True)
            with log.open("a") as file:
                file.write(json.dumps({"cell": cell.name(), "method": method, "found": found}) + "\n")
    kept = {}
    for line in log.read_text().splitlines():
        entry = json.loads(line)
        kept[entry["cell"], entry["method"]] = entry["found"]
    publish(f"dimensions-{options.threads}", f"{hardware()}\n\n{table(every, kept)}")


def table(every: list[Cell], kept: dict[tuple[str, str], dict[str, Any]]) -> str:
    """A row for each size, with each covariance type's speed and memory relative to scikit-learn's."""
    rows: dict[tuple[Any, ...], list[str]] = {}
    for cell in every:
        size = (cell.table or "blobs", f"{cell.n:,} × {cell.dim}", cell.k)
        row = rows.setdefault(size, [""] * len(COVARIANCE_TYPES))
        ours, peer = (kept.get((cell.name(), method), {}) for method in ("gmmtorch", "scikit-learn"))
        if "seconds" in ours and "seconds" in peer:
            row[COVARIANCE_TYPES.index(cell.kind)] = comparison(ours, peer, bool(cell.table))
    lines = [[*size, *row] for size, row in rows.items() if any(row)]
    return markdown(["cloud", "points", "K", *COVARIANCE_TYPES], lines)


def comparison(ours: dict[str, Any], peer: dict[str, Any], own_start: bool) -> str:
    """Seconds of both; how many times faster fit and score are; the share of memory, if it is measurable."""
    fit, score = (peer[name] / ours[name] for name in ("seconds", "score_seconds"))
    text = f"{ours['seconds']:.2g} / {peer['seconds']:.2g} s: {fit:.1f}×, score {score:.1f}×"
    if peer["megabytes"] > 10 or ours["megabytes"] > 10:
        text += f", memory {ours['megabytes'] / max(peer['megabytes'], 1):.2f}"
    if own_start:
        return f"{text}, nats {ours['nats']:.2f} / {peer['nats']:.2f}"
    different = abs(ours["nats"] - peer["nats"]) / abs(peer["nats"])
    return text if different < 1e-6 else f"{text}, nats differ by {different:.0e}"


if __name__ == "__main__":
    main()
