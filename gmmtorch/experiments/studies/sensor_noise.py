"""Effect of a sensor noise model in learning: likelihood and occupancy against bytes.

Four variants learn from the same points, from the same initialization, with the same number of components:

    plain           EM; the noise makes the components thicker
    planar          EM whose components are at most as thick as the sensor's typical noise
    noise           extreme deconvolution with a noise covariance for every point
    noise_planar    both

Every variant is scored by the mean log density (nats per point) of the same held-out measurements. For a
variant with the noise model a measurement is a position plus noise of covariance R_n, with density
Σ_k π_k N(x | μ_k, Σ_k + R_n). For a variant without it the noise is part of the components, with density
Σ_k π_k N(x | μ_k, Σ_k). Every row contains both densities.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Sequence
from typing import NamedTuple

import torch
from sklearn.exceptions import ConvergenceWarning
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import (
    Queries,
    auc_interval,
    hit_and_free,
    roc,
    split_indices,
    test_beams,
)
from gmmtorch.experiments.studies.study_options import SensorModelStudy
from gmmtorch.mapping import GaussianMap
from gmmtorch.mixture import DeconvolvedGaussianMixture, LidarModel, SensorModel, estimate_normals
from gmmtorch.report import Event, Row, ignore
from gmmtorch.scan import Scan

VARIANTS = ("plain", "planar", "noise", "noise_planar")


class _Cloud(NamedTuple):
    """Points (N, D), their noise covariances (N, D, D), and the index of each point's scan (N,)."""

    points: Tensor
    noise: Tensor
    scan: Tensor


def run_sensor_noise(
    name: str, scans: Sequence[Scan], study: SensorModelStudy, seed: int = 0, on_event: Event = ignore
) -> list[Row]:
    """A row for each variant and size, scored on the held-out scans.

    Args:
        name: of the data set, for the rows.
        scans: in time order.
        study: sensor model, sizes and test.
        seed: of the points drawn, the initialization of EM, the free points and the map's rays.

    Fields that say more than their name: held_out_log_likelihood, by the variant's own density (nats per
    point); auc: against free points anywhere on the beams; auc_near_surface: 0.5 to 2 cells before the hit;
    thickness: median of the components' smallest standard deviations (m); sensor_deviation: median standard
    deviation of the training points along the beam (m).
    """
    sensor = LidarModel(noise=0.01) if study.sensor is None else study.sensor
    train_index, test_index = split_indices(len(scans), study.test_every)
    train = [scans[i] for i in train_index]
    cloud = _training_cloud(train, sensor, study, seed)
    origins, ends = test_beams([scans[i] for i in test_index], study.max_beams, seed)
    test_noise = sensor.noise_covariances(ends, origins, _normals(ends, study.n_neighbors))
    asked = {
        "auc": hit_and_free(origins, ends, "uniform", study.resolution, seed),
        "auc_near_surface": hit_and_free(origins, ends, "near_surface", study.resolution, seed),
    }
    n_total = sum(scan.points.shape[0] for scan in train)
    typical = float(torch.linalg.eigvalsh(cloud.noise)[:, -1].median().sqrt())
    rows: list[Row] = []
    stages = [(k, variant) for k in study.n_components for variant in VARIANTS]
    for done, (k, variant) in enumerate(stages):
        on_event("sensor model", done, len(stages))
        begin = time.perf_counter()
        mixture = _learn(cloud, variant, k, typical, study, seed)
        seconds = time.perf_counter() - begin
        built = _as_map(mixture, cloud, train, n_total, study, seed)
        row: Row = {"dataset": name, "variant": variant}
        row |= {"n_components": built.n_components, "nbytes": built.nbytes, "seconds": seconds}
        row |= _scores(mixture, variant, ends, test_noise)
        row |= _areas(built, asked, study.resolution, seed)
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


def _scores(mixture: DeconvolvedGaussianMixture, variant: str, ends: Tensor, noise: Tensor) -> Row:
    """What a fitted mixture says of itself and of held-out hits (N, 3) with their noise (N, 3, 3)."""
    added = float(torch.as_tensor(mixture.score_samples(ends, noise)).mean())
    fitted = mixture.score(ends)
    return {
        "n_iterations": mixture.n_iter_,
        "converged": mixture.converged_,
        "held_out_log_likelihood": added if variant.startswith("noise") else fitted,
        "log_likelihood_noise_added": added,
        "log_likelihood_as_fitted": fitted,
    }


def _areas(built: GaussianMap, asked: dict[str, Queries], resolution: float, seed: int) -> Row:
    """The areas under the ROC curve of a map's answers, and the interval of `auc`."""
    row: Row = {}
    for field, ask in asked.items():
        theta = torch.as_tensor(built.occupancy(ask.points, resolution))
        occupied, empty = ask.split(theta)
        row[field] = area = roc(occupied, empty).auc
        if field == "auc":
            row["auc_low"], row["auc_high"] = auc_interval(occupied, empty, area, seed)
    return row


def _normals(points: Tensor, n_neighbors: int) -> Tensor | None:
    return estimate_normals(points, n_neighbors) if n_neighbors else None


def _training_cloud(train: Sequence[Scan], sensor: SensorModel, study: SensorModelStudy, seed: int) -> _Cloud:
    """A random sample of the points of all scans, with their noise."""
    sizes = torch.tensor([scan.points.shape[0] for scan in train])
    if int(sizes.sum()) == 0:
        raise InvalidArgumentError("The training scans have no points; check ‹max_range›.")
    generator = torch.Generator().manual_seed(seed)
    chosen = torch.randperm(int(sizes.sum()), generator=generator)[: study.n_points].sort().values
    index = torch.repeat_interleave(sizes)[chosen]
    points = torch.cat([scan.points for scan in train])[chosen.to(train[0].points.device)].double().cpu()
    origins = torch.stack([scan.origin.double().cpu() for scan in train])[index]
    noise = sensor.noise_covariances(points, origins, _normals(points, study.n_neighbors))
    return _Cloud(points, noise, index)


def _learn(
    cloud: _Cloud, variant: str, n_components: int, typical: float, study: SensorModelStudy, seed: int
) -> DeconvolvedGaussianMixture:
    mixture = DeconvolvedGaussianMixture(
        n_components,
        tol=study.tol,
        max_iter=study.max_iter,
        thickness=max(typical, 1e-3) if variant.endswith("planar") else None,
        random_state=seed,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ConvergenceWarning)  # the row contains `converged`
        return mixture.fit(
            cloud.points, noise_covariances=cloud.noise if variant.startswith("noise") else None
        )


def _as_map(
    mixture: DeconvolvedGaussianMixture,
    cloud: _Cloud,
    train: Sequence[Scan],
    n_total: int,
    study: SensorModelStudy,
    seed: int,
) -> GaussianMap:
    """The mixture as a map; the viewpoints of a component are the scans with most of its points."""
    owner = torch.as_tensor(mixture.predict(cloud.points))
    k, s = mixture.weights.shape[0], len(train)
    counts = torch.bincount(owner * s + cloud.scan, minlength=k * s).view(k, s)
    most = counts.topk(min(study.max_origins, s), dim=1)
    alive = counts.sum(1) > 0  # a component without points has no viewpoints
    origins = [scan.origin.double().cpu() for scan in train]
    viewpoints = [
        [(origins[i], float(n)) for i, n in zip(views, numbers, strict=True) if n > 0]
        for views, numbers in zip(most.indices[alive].tolist(), most.values[alive].tolist(), strict=True)
    ]
    support = mixture.weights * n_total
    return GaussianMap.from_components(
        mixture.means[alive],
        mixture.covariances[alive],
        support[alive],
        viewpoints,
        resolution=study.resolution,
        cutoff=5.0,  # the options with which the published figures were made
        prior=1.0,
        n_samples=study.n_samples,
        random_state=seed,
    )
