"""Mixtures of given parameters and mixtures in files, valid and invalid."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from mixture.mixture_cases import blobs, fitted, given_start
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError
from gmmtorch.files import pack_tensors
from gmmtorch.mixture import GaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


# -- given parameters ------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_from_parameters_gives_a_fitted_mixture(kind, tmp_path):
    gmm = fitted()
    parts = (kind(p.copy()) for p in (gmm.weights_, gmm.means_, gmm.covariances_))
    other = GaussianMixture.from_parameters(*parts, tol=0.5, lower_bounds=[-3.0, -2.0], converged=False)
    assert (other.n_components, other.tol, other.n_iter_, other.lower_bound_, other.converged_) == (
        3,
        0.5,
        2,
        -2.0,
        False,
    )
    assert (other.score_samples(blobs()) == gmm.score_samples(blobs())).all()
    assert isinstance(other.means_, Tensor) == (kind is torch.from_numpy)
    other.save(tmp_path / "m.safetensors")
    assert torch.equal(GaussianMixture.load(tmp_path / "m.safetensors").means, gmm.means)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("weights", [0.5, 0.6]),
        ("weights", [1.5, -0.5]),
        ("weights", [1.0]),
        ("means", [[0.0, 0.0], [np.nan, 0.0]]),
        ("means", [0.0, 1.0]),
        ("covariances", np.eye(2)),
        ("covariances", np.stack([np.eye(2), -np.eye(2)])),
    ],
)
def test_from_parameters_rejects_invalid_values(name, value):
    valid = {"weights": [0.5, 0.5], "means": np.zeros((2, 2)), "covariances": np.stack([np.eye(2)] * 2)}
    GaussianMixture.from_parameters(**{k: np.asarray(v) for k, v in valid.items()})
    with pytest.raises(GmmTorchError, match=name):
        GaussianMixture.from_parameters(**{k: np.asarray(v) for k, v in {**valid, name: value}.items()})


# -- files -----------------------------------------------------------------------------------------


def test_options_that_json_lacks_do_not_prevent_saving(tmp_path):
    start = {name: torch.from_numpy(value) for name, value in given_start(2).items()}
    gmm = GaussianMixture(
        3, **start, random_state=torch.Generator().manual_seed(0), tol=np.float32(0.01)
    ).fit(blobs())
    gmm.save(tmp_path / "m.safetensors")
    assert torch.equal(GaussianMixture.load(tmp_path / "m.safetensors").means, gmm.means)


MISSING = object()


def valid_parts() -> tuple[dict[str, Tensor], dict]:
    gmm = fitted()
    tensors = {name: getattr(gmm, name).clone() for name in ("weights", "means", "covariances")}
    facts = {"lower_bounds": [-1.0], "converged": True, "arrays": True, "parameters": {"n_components": 3}}
    return tensors, facts


def write_parts(folder: Path, tensors: dict[str, Tensor], facts: dict) -> Path:
    path = folder / "m.safetensors"
    path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **facts))
    return path


@pytest.mark.parametrize(
    "change",
    [
        {"weights": torch.tensor([0.5, 0.6, -0.1], dtype=torch.float64)},
        {"weights": torch.ones(3, dtype=torch.float64)},
        {"weights": torch.ones(2, dtype=torch.float64) / 2},
        {"weights": torch.ones(3) / 3},
        {"weights": torch.full((3,), float("nan"), dtype=torch.float64)},
        {"means": torch.zeros(3, dtype=torch.float64)},
        {"means": torch.zeros(0, 2, dtype=torch.float64)},
        {"means": torch.zeros(3, 0, dtype=torch.float64)},
        {"means": torch.full((3, 2), float("inf"), dtype=torch.float64)},
        {"means": None},
        {"covariances": torch.zeros(3, 2, dtype=torch.float64)},
        {"covariances": -torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)},
        {"covariances": torch.tensor([[1.0, 0.9], [-0.9, 1.0]], dtype=torch.float64).repeat(3, 1, 1)},
    ],
    ids=lambda c: next(iter(c)),
)
def test_file_with_invalid_tensors_is_rejected(tmp_path, change):
    tensors, facts = valid_parts()
    tensors = {k: v for k, v in {**tensors, **change}.items() if v is not None}
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(write_parts(tmp_path, tensors, facts))


@pytest.mark.parametrize(
    "change",
    [
        {"lower_bounds": "text"},
        {"lower_bounds": None},
        {"parameters": 7},
        {"parameters": "text"},
        {"arrays": None, "parameters": None},
        *({"features": names} for names in (["x"], ["x", 2], [["x"], "y"], 7, "text", True)),
        *({name: MISSING} for name in ("lower_bounds", "converged", "arrays", "parameters")),
    ],
)
def test_file_with_invalid_or_missing_facts_is_rejected(tmp_path, change):
    tensors, facts = valid_parts()
    facts = {name: value for name, value in {**facts, **change}.items() if value is not MISSING}
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(write_parts(tmp_path, tensors, facts))


def test_unknown_parameters_in_a_file_are_ignored(tmp_path):
    tensors, facts = valid_parts()
    facts["parameters"] = {"n_components": 3, "unheard_of": 1, "tol": 0.5}
    assert GaussianMixture.load(write_parts(tmp_path, tensors, facts)).tol == 0.5
