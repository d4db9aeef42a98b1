"""Mixtures in many dimensions, beside scikit-learn: seconds, peak memory and log-likelihoods.

    python benchmarks/dimensions.py [--threads 1] [--parts TEXT …] [--most 6e10] [--peers tgmm torchgmm]

Both fit the same clouds from the same start for the same number of iterations; --most leaves out fits of
more products of N, K and D (full covariances: D²). Whole fits start as each package does by itself.
"""

from __future__ import annotations

import ctypes
import itertools
import logging
import math
import sys
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import sklearn.mixture
import torch
from scipy.ndimage import gaussian_filter
from sklearn.datasets import load_digits, load_iris

import gmmtorch
from gmmtorch.experiments.harness import Case, Row, alone, clock, run
from gmmtorch.mixture.em.exact import COVARIANCE_TYPES, type_shape

N_ITER = 3
MOST_SAMPLED = 50_000
SEED = 5
SEEDS = {"digits": 10, "iris": 10, "images": 3}
"""Starts whose nats are averaged: the nats of one differ more than those of two packages."""


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


def images(n: int, dim: int) -> np.ndarray:
    """Images like handwritten digits: strokes of 50 styles, moved and weakened; four of five pixels are 0."""
    rng, side = np.random.default_rng(SEED), math.isqrt(dim)
    strokes = gaussian_filter(rng.normal(size=(50, side, side)), (0, 2, 2))
    edge = np.minimum(*np.meshgrid(*[np.minimum(np.arange(side), side - 1 - np.arange(side))] * 2))
    strokes = np.where(edge > 3, strokes, -np.inf)
    level = np.quantile(strokes[np.isfinite(strokes)].reshape(50, -1), 0.6, axis=1)[:, None, None]
    strokes = np.clip(2000 * (strokes - level), 0, 255)
    styles, moves = rng.integers(50, size=n), rng.integers(-2, 3, size=(n, 2))
    moved = np.empty((n, dim))
    for style, down, right in itertools.product(range(50), range(-2, 3), range(-2, 3)):
        own = (styles == style) & (moves[:, 0] == down) & (moves[:, 1] == right)
        moved[own] = np.roll(strokes[style], (down, right), (0, 1)).ravel()
    faint = rng.random((n, dim), np.float32) ** 0.3
    return np.floor(moved * faint)


TABLES: dict[str, Callable[[int, int], np.ndarray]] = {
    "one-hot": one_hot,
    "digits": lambda n, dim: np.asarray(load_digits().data),
    "iris": lambda n, dim: np.asarray(load_iris().data),
    "images": images,
    "blobs, own start": lambda n, dim: blobs(n, dim, 16),
}


def cells(most: float) -> list[Cell]:
    dims = 1, 2, 3, 8, 16, 64, 128, 384
    every = itertools.product((2000, 50_000, 10**6), dims, (8, 64, 512), COVARIANCE_TYPES)
    grid = [Cell(kind, n, dim, k) for n, dim, k, kind in every]
    own = [Cell("full", 1477, 284, 100, "one-hot"), Cell("diag", 50_000, 128, 16, "blobs, own start")]
    own += [Cell("diag", 60_000, 784, 50, "images")]
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


def fitted(package: str, points: np.ndarray, cell: Cell, seed: int) -> Any:
    """The mixture that a package fits to a cell's points."""
    options: dict[str, Any] = {"covariance_type": cell.kind, "reg_covar": 1e-6, "random_state": seed}
    options |= {} if cell.table else start(points, cell)
    if package == "scikit-learn":
        return sklearn.mixture.GaussianMixture(cell.k, **options).fit(points)
    if package == "gmmtorch":
        options |= {"init_params": "kmeans"} if cell.table else {"algorithm": "exact"}
        return gmmtorch.GaussianMixture(cell.k, **options).fit(points)
    table, means = torch.from_numpy(points), torch.from_numpy(options["means_init"])
    if package == "torchgmm":  # takes no other start, and makes float32 of float64
        limits = {
            "convergence_tolerance": 0.0,
            "trainer_params": {"max_epochs": N_ITER, "logger": False, "enable_progress_bar": False},
        }
        made = import_module("torchgmm.bayes").GaussianMixture
        return made(cell.k, covariance_type=cell.kind, init_means=means.float(), **limits).fit(table.float())
    covariances = 1 / torch.from_numpy(options["precisions_init"]).clamp_min(1e-300)
    if cell.kind in ("full", "tied"):
        covariances = torch.linalg.inv(torch.from_numpy(options["precisions_init"]))
    first = {"init_means": means, "init_covariances": covariances}
    settings = {"covariance_type": cell.kind, "max_iter": N_ITER, "tol": 1e-300, "random_state": seed}
    return import_module("tgmm").GaussianMixture(cell.k, cell.dim, **settings, **first).fit(table)


ANSWERS: dict[str, Callable[[Any, Any], object]] = {
    "score": lambda mixture, points: mixture.score_samples(points),
    "predict": lambda mixture, points: mixture.predict(points),
    "sample": lambda mixture, points: mixture.sample(min(len(points), MOST_SAMPLED)),
}


def least(answer: Callable[[], object]) -> float:
    """The least seconds of three calls; of fewer, if they take long."""
    seconds: list[float] = []
    while len(seconds) < 3 and sum(seconds) < 5:
        begin = clock()
        answer()
        seconds.append(clock() - begin)
    return min(seconds)


def measured(cell: Cell, packages: tuple[str, ...]) -> dict[str, dict[str, float]]:
    """Seconds of the processor of a fit and of what it answers, the memory of the fit, and what it found.

    The packages take turns, because other programs load the machine.
    """
    points = TABLES[cell.table](cell.n, cell.dim) if cell.table else blobs(cell.n, cell.dim, cell.k)
    table = {name: torch.from_numpy(points) for name in packages} | {
        "gmmtorch": points,
        "scikit-learn": points,
    }
    table["torchgmm"] = torch.from_numpy(points).float()
    found: dict[str, list[tuple[float, ...]]] = {name: [] for name in packages}
    n_seeds, total = SEEDS.get(cell.table, 1), 0.0
    for seed in range(20):
        for name in packages if seed % 2 else packages[::-1]:
            ctypes.CDLL(None).malloc_trim(0)
            Path("/proc/self/clear_refs").write_text("5")  # the peak starts anew
            before = status("VmRSS")
            begin = clock()
            mixture = fitted(name, points, cell, seed)
            seconds, megabytes = clock() - begin, status("VmHWM") - before
            value = float(mixture.score(table[name]))  # makes what the next ones find
            value = -value if name == "torchgmm" else value  # the negative log-likelihood
            answers = [least(lambda m=mixture, x=table[name], of=of: of(m, x)) for of in ANSWERS.values()]
            found[name].append((seconds, *answers, megabytes, value))
            total += seconds + sum(answers)
        if seed + 1 >= n_seeds and (total > 3 or (total > 1 and seed >= 4)):
            break
    result = {}
    for name, runs in found.items():
        low = np.min(runs, 0)
        nats = float(np.mean([run[-1] for run in runs[:n_seeds]]))
        result[name] = dict(zip(("seconds", *ANSWERS, "megabytes"), low, strict=False)) | {"nats": nats}
    return result


def together(cells: list[Cell], packages: tuple[str, ...]) -> dict[str, Any]:
    """The measurements of some cells, by the kind of covariances."""
    warnings.simplefilter("ignore")
    logging.disable()
    measured(Cell("full", 2000, 3, 8), packages)  # loads libraries and compiles
    return {cell.kind: measured(cell, packages) for cell in cells}


def measure(options: Any) -> Iterator[Row]:
    """A row for each size, with each covariance type's speed and memory relative to scikit-learn's."""
    sizes: dict[tuple[Any, ...], list[Cell]] = {}
    for cell in cells(options.most):
        if all(part in cell.name() for part in options.parts or ()) and not (cell.table and options.peers):
            cloud = " beside ".join(filter(None, [cell.table or "blobs", ", ".join(options.peers)]))
            sizes.setdefault((cloud, f"{cell.n:,} × {cell.dim}", cell.k), []).append(cell)
    packages = ("gmmtorch", "scikit-learn", *options.peers)
    for (cloud, points, k), some in sizes.items():
        found = alone(together, some, packages)
        if "error" in found:
            print(cloud, points, k, found, file=sys.stderr)
            continue
        row: dict[str, Any] = {"cloud": cloud, "points": points, "K": k} | dict.fromkeys(COVARIANCE_TYPES)
        yield row | {cell.kind: comparison(found[cell.kind], bool(cell.table)) for cell in some}


def times(peer: dict[str, float], ours: dict[str, float], name: str) -> str:
    """How many times faster ours is."""
    return f"{peer[name] / ours[name]:.2g}×"


def comparison(found: dict[str, dict[str, float]], own_start: bool) -> str:
    """Seconds; how many times faster the fit and what it answers are; the share of memory, if measurable."""
    ours, peer, *others = found.values()
    text = f"{ours['seconds']:.2g} / {peer['seconds']:.2g} s: {times(peer, ours, 'seconds')}"
    text += "".join(f", {name} {times(peer, ours, name)}" for name in ANSWERS)
    if peer["megabytes"] > 10 or ours["megabytes"] > 10:
        text += f", memory {ours['megabytes'] / max(peer['megabytes'], 1):.2f}"
    for name, other in zip(list(found)[2:], others, strict=True):
        text += f"; {name} {other['seconds']:.2g} s, score {other['score'] / ours['score']:.1f}×"
        text += f", memory {ours['megabytes'] / max(other['megabytes'], 1):.2f}, nats {other['nats']:.4g}"
    if own_start or others:
        return f"{text}, nats {ours['nats']:.2f} / {peer['nats']:.2f}"
    different = abs(ours["nats"] - peer["nats"]) / abs(peer["nats"])
    return text if different < 1e-6 else f"{text}, nats differ by {different:.0e}"


CASE = Case(
    "dimensions-{threads}",
    measure,
    "Three iterations from the same start; the last rows are whole fits, each from its own start from "
    "k-means, with the nats of both (means over ten seeds of digits and iris, three of images). A cell: our "
    "CPU seconds / those of scikit-learn, how many times faster are fit, repeated score and predict, and "
    "sample (at most 50,000 points), our share of its peak memory where either is above 10 MB.",
    {"K": ".0f"},
    key=3,
    needs_data=False,
)

if __name__ == "__main__":
    run(
        __doc__,
        CASE,
        parts={"nargs": "*", "help": "cells whose names contain all of these"},
        most={"type": float, "default": 2e10, "help": "products of a cell's iteration"},
        peers={"nargs": "*", "default": [], "help": "tgmm, torchgmm: blobs only"},
    )
