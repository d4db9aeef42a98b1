"""Does it pay to tell the learning how the sensor errs? Likelihood and occupancy against bytes.

Four variants learn from the same points, from the same start, with the same number of components:

    plain           EM: components are as thick as the noise makes the surfaces look
    planar          EM whose components are no thicker than the sensor's typical noise
    noise           extreme deconvolution with a noise covariance for every point
    noise_planar    both

What is held out are measurements: noisy points. Every variant is scored by the density that it gives
to them, in nats a point: of the same points in the same space, so the numbers can be compared. A
variant with the noise model holds that a measurement is a position plus noise of covariance R_n, so
its density is Σ_k π_k N(x | μ_k, Σ_k + R_n); one without holds that noise is part of its components,
Σ_k π_k N(x | μ_k, Σ_k). Both are in every row whatever the variant, since each is one side's view.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError, check_whole
from gmmtorch.evaluation import metrics, queries, split
from gmmtorch.evaluation.events import Event, ignore
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mixture.estimators.deconvolved import DeconvolvedGaussianMixture
from gmmtorch.mixture.estimators.sensor_model import (
    DepthCameraModel,
    LaserModel,
    LidarModel,
    SensorModel,
    estimate_normals,
)
from gmmtorch.occupancy.grid import check_resolution
from gmmtorch.scan import Scan

SENSORS: dict[str, type[DepthCameraModel] | type[LidarModel] | type[LaserModel]] = {
    "depth_camera": DepthCameraModel,
    "lidar": LidarModel,
    "laser_2d": LaserModel,
}
"""Sensor models by name: a configuration names one, and may change its fields."""

VARIANTS = ("plain", "planar", "noise", "noise_planar")


@dataclass(frozen=True)
class NoiseStudy:
    """What is compared.

    n_components: sizes K. n_points: training points learned from, drawn at random from all. resolution:
    side (m) of the cells that occupancy is asked about. test_every: scans 0, n, 2n, … are held out.
    max_beams: held-out beams at most. max_iter, tol: of EM. n_neighbors: of which a point's normal is
    estimated, for the angle at which it was seen; 0: every surface is taken to be seen head-on.
    max_origins: sensor positions kept for a component. n_samples: rays drawn from a map to answer.
    """

    n_components: Sequence[int] = (50, 200)
    n_points: int = 20_000
    resolution: float = 0.1
    test_every: int = 10
    max_beams: int = 20_000
    max_iter: int = 50
    tol: float = 1e-4
    n_neighbors: int = 16
    max_origins: int = 8
    n_samples: int = 1_000_000

    def __post_init__(self) -> None:
        if not self.n_components:
            raise InvalidArgumentError("n_components=() names no size; give at least one.")
        for k in self.n_components:
            check_whole("n_components", k, 1)
        for name in ("n_points", "max_beams", "max_iter", "max_origins", "n_samples"):
            check_whole(name, getattr(self, name), 1)
        check_whole("n_neighbors", self.n_neighbors, 0)
        split.check_test_every(self.test_every)
        check_resolution(self.resolution)


@dataclass(frozen=True)
class _Cloud:
    """Points (N, D), the noise covariance of each (N, D, D), and the scan (N,) that each is from."""

    points: Tensor
    noise: Tensor
    scan: Tensor


def run(
    name: str,
    scans: Sequence[Scan],
    sensor: SensorModel,
    study: NoiseStudy | None = None,
    seed: int = 0,
    on_event: Event = ignore,
) -> list[dict[str, Any]]:
    """Learn every variant at every size, and score it on the held-out scans.

    Args:
        name: of the data set, for the rows.
        scans: in the order they were taken.
        sensor: how their points err; see `SENSORS` and `gmmtorch.mixture.estimators.sensor_model`.
        study: sizes and test.
        seed: of the points drawn, the start of EM, the free points and the map's rays.
        on_event: told of progress.

    Returns rows of: dataset, variant, n_components, nbytes (of the map, as stored), seconds,
    n_iterations, converged, held_out_log_likelihood (the variant's own density of the held-out
    measurements, nats a point), log_likelihood_noise_added and log_likelihood_as_fitted (either
    density), auc, auc_low, auc_high (hits against free points anywhere on the beams),
    auc_near_surface (against free points half to two cells before the hit), thickness (median
    smallest standard deviation of the components, m), sensor_deviation (median along the beam of
    the training points, m), resolution, n_train_points, n_test_beams.
    """
    study = study or NoiseStudy()
    train_index, test_index = split.split_indices(len(scans), study.test_every)
    train = [scans[i] for i in train_index]
    cloud = _training_cloud(train, sensor, study, seed)
    origins, ends = queries.test_beams([scans[i] for i in test_index], study.max_beams, seed)
    test_noise = sensor.noise_covariances(ends, origins, _normals(ends, study.n_neighbors))
    asked = {
        "auc": queries.hit_and_free(origins, ends, "uniform", study.resolution, seed),
        "auc_near_surface": queries.hit_and_free(origins, ends, "near_surface", study.resolution, seed),
    }
    n_total = sum(scan.points.shape[0] for scan in train)
    typical = float(torch.linalg.eigvalsh(cloud.noise)[:, -1].median().sqrt())
    rows: list[dict[str, Any]] = []
    stages = [(k, variant) for k in study.n_components for variant in VARIANTS]
    for done, (k, variant) in enumerate(stages):
        on_event("sensor model", done, len(stages))
        begin = time.perf_counter()
        mixture = _learn(cloud, variant, k, typical, study, seed)
        seconds = time.perf_counter() - begin
        built = _as_map(mixture, cloud, train, n_total, study, seed)
        added = float(torch.as_tensor(mixture.score_samples(ends, test_noise)).mean())
        fitted = mixture.score(ends)
        row: dict[str, Any] = {
            "dataset": name,
            "variant": variant,
            "n_components": built.n_components,
            "nbytes": built.nbytes,
            "seconds": seconds,
            "n_iterations": mixture.n_iter_,
            "converged": mixture.converged_,
            "held_out_log_likelihood": added if variant.startswith("noise") else fitted,
            "log_likelihood_noise_added": added,
            "log_likelihood_as_fitted": fitted,
        }
        for field, ask in asked.items():
            theta = torch.as_tensor(built.occupancy(ask.points, study.resolution))
            occupied, empty = theta[ask.of(queries.OCCUPIED)], theta[ask.of(queries.FREE)]
            row[field] = area = metrics.roc(occupied, empty).auc
            if field == "auc":
                row["auc_low"], row["auc_high"] = metrics.auc_interval(occupied, empty, area, seed)
        smallest = torch.linalg.eigvalsh(mixture.covariances)[:, 0]
        row |= {
            "thickness": float(smallest.median().sqrt()),
            "sensor_deviation": typical,
            "resolution": float(study.resolution),
            "n_train_points": cloud.points.shape[0],
            "n_test_beams": ends.shape[0],
        }
        rows.append(row)
    on_event("sensor model", len(stages), len(stages))
    return rows


def _normals(points: Tensor, n_neighbors: int) -> Tensor | None:
    return estimate_normals(points, n_neighbors) if n_neighbors else None


def _training_cloud(train: Sequence[Scan], sensor: SensorModel, study: NoiseStudy, seed: int) -> _Cloud:
    """Points drawn from all scans together, and their noise."""
    sizes = torch.tensor([scan.points.shape[0] for scan in train])
    if int(sizes.sum()) == 0:
        raise InvalidArgumentError(
            "The training scans have no points to learn from; check dataset.max_range."
        )
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(int(sizes.sum()), generator=generator)[: study.n_points].sort().values
    index = torch.repeat_interleave(sizes)[chosen]
    points = torch.cat([scan.points for scan in train])[chosen.to(train[0].points.device)].double().cpu()
    origins = torch.stack([scan.origin.double().cpu() for scan in train])[index]
    noise = sensor.noise_covariances(points, origins, _normals(points, study.n_neighbors))
    return _Cloud(points, noise, index)


def _learn(
    cloud: _Cloud, variant: str, n_components: int, typical: float, study: NoiseStudy, seed: int
) -> DeconvolvedGaussianMixture:
    mixture = DeconvolvedGaussianMixture(
        n_components,
        tol=study.tol,
        max_iter=study.max_iter,
        thickness=max(typical, 1e-3) if variant.endswith("planar") else None,
        random_state=seed,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # whether it converged is in the row
        return mixture.fit(
            cloud.points, noise_covariances=cloud.noise if variant.startswith("noise") else None
        )


def _as_map(
    mixture: DeconvolvedGaussianMixture,
    cloud: _Cloud,
    train: Sequence[Scan],
    n_total: int,
    study: NoiseStudy,
    seed: int,
) -> GaussianMap:
    """The mixture as a map: each component seen from the scans that most of its points are from."""
    owner = torch.as_tensor(mixture.predict(cloud.points))
    k, s = mixture.weights.shape[0], len(train)
    counts = torch.bincount(owner * s + cloud.scan, minlength=k * s).view(k, s)
    most = counts.topk(min(study.max_origins, s), dim=1)
    alive = counts.sum(1) > 0  # what is no point's likeliest component was seen from nowhere
    origins = [scan.origin.double().cpu() for scan in train]
    seen = [
        [(origins[i], float(n)) for i, n in zip(views, numbers, strict=True) if n > 0]
        for views, numbers in zip(most.indices[alive].tolist(), most.values[alive].tolist(), strict=True)
    ]
    support = mixture.weights * n_total
    return GaussianMap.from_components(
        mixture.means[alive],
        mixture.covariances[alive],
        support[alive],
        seen,
        resolution=study.resolution,
        n_samples=study.n_samples,
        random_state=seed,
    )
