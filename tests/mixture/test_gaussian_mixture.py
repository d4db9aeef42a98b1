"""GaussianMixture: scikit-learn's results, starts, kinds of arrays, awkward clouds and gradients."""

from __future__ import annotations

import math
import warnings

import numpy as np
import pytest
import torch
from mixture.mixture_cases import MISSING, DtypeRecorder, blobs, changed_file, fitted, given_start
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.kernels import kernels
from gmmtorch.mixture import GaussianMixture

pytestmark = pytest.mark.filterwarnings("ignore::sklearn.exceptions.ConvergenceWarning")


SEEDED = ["kmeans", "random_points", "bounding_box"]
INITS = [*SEEDED, "flat_pieces"]


# -- against scikit-learn --------------------------------------------------------------------------


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_float64_fit_and_queries_create_no_float32_tensor(init, kind):
    x = kind(blobs(200))
    with DtypeRecorder() as recorder:
        gmm = GaussianMixture(3, random_state=0, dtype="float64", init_params=init, max_iter=5)
        gmm.fit(x, sample_weight=kind(np.linspace(0.5, 2, 200)))
        gmm.score_samples(x), gmm.predict_proba(x), gmm.predict(x), gmm.bic(x), gmm.sample(5)
        gmm.precisions_  # noqa: B018
    assert recorder.seen.keys() == {torch.float64}, recorder.seen


def test_dtype_recorder_detects_float32():
    with kernels("torch"), DtypeRecorder() as recorder:
        GaussianMixture(2, random_state=0, dtype="float32").fit(blobs(100))
    assert torch.float32 in recorder.seen


# -- kinds -----------------------------------------------------------------------------------------


def test_integers_lists_and_half_precision_are_accepted():
    x = torch.from_numpy(10 * blobs()).long()
    gmm = GaussianMixture(2, random_state=0).fit(x)
    assert torch.equal(gmm.score_samples(x), gmm.score_samples(x.double()))
    assert torch.equal(gmm.means, GaussianMixture(2, random_state=0).fit(x.numpy()).means)
    assert gmm.score_samples(x.numpy().tolist()).dtype == np.float64
    far = 300 * torch.ones(1, x.shape[1])
    assert torch.equal(gmm.score_samples(far.half()), gmm.score_samples(far.double()))  # below −65,504


# -- starts ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("init", SEEDED)
def test_n_init_keeps_the_best_start(init):
    x = blobs(300)
    options = {"init_params": init, "max_iter": 4, "dtype": "float64"}
    one_by_one = torch.Generator().manual_seed(5)
    each = [GaussianMixture(6, random_state=one_by_one, **options).fit(x) for _ in range(4)]
    bounds = [gmm.lower_bound_ for gmm in each]
    best = GaussianMixture(6, random_state=torch.Generator().manual_seed(5), n_init=4, **options).fit(x)
    assert len(set(bounds)) > 1
    assert best.lower_bound_ == max(bounds)
    assert (best.means_ == each[int(np.argmax(bounds))].means_).all()


def test_fits_without_a_seed_differ():
    x = blobs()
    fits = [GaussianMixture(5, init_params="random_points", max_iter=1).fit(x).means_ for _ in range(2)]
    assert not (fits[0] == fits[1]).all()


@pytest.mark.parametrize(
    ("n_components", "dim", "words"), [(5, 2, ("n_components",)), (3, 3, ("warm_start", "X"))]
)
def test_warm_start_with_another_shape_is_rejected_or_restarts(n_components, dim, words):
    gmm = GaussianMixture(3, warm_start=True, random_state=0).fit(blobs())
    gmm.set_params(n_components=n_components)
    try:
        gmm.fit(blobs(dim=dim))
    except InvalidArgumentError as error:
        assert any(word in str(error) for word in words)  # noqa: PT017 - either result is correct
    else:
        assert gmm.means_.shape == (n_components, dim)


# -- awkward clouds --------------------------------------------------------------------------------


def all_finite(gmm: GaussianMixture) -> bool:
    values = (gmm.weights_, gmm.means_, gmm.covariances_, gmm.lower_bound_)
    return all(bool(np.isfinite(v).all()) for v in values)


@pytest.mark.parametrize("init", INITS)
def test_more_components_than_distinct_points_share_weights(init):
    x = np.repeat([[0.0, 0.0], [1.0, 0.0], [0.0, 5.0]], [10, 20, 30], axis=0)
    gmm = GaussianMixture(7, init_params=init, random_state=0, max_iter=200, tol=1e-9).fit(x)
    assert all_finite(gmm)
    assert gmm.weights_.sum() == pytest.approx(1)
    # The optimum: a component of variance reg_covar at each place, with its share of the points.
    expected = np.log(np.array([1, 2, 3]) / 6) - math.log(2 * math.pi * 1e-6)
    if init != "bounding_box":  # from which two places may end in one component
        np.testing.assert_allclose(gmm.score_samples(x[[0, 10, 30]]), expected, atol=1e-4)


@pytest.mark.parametrize("init", INITS)
@pytest.mark.parametrize(("dim", "rank"), [(2, 0), (2, 1), (3, 1), (3, 2)])
def test_equal_collinear_and_coplanar_points_give_flat_components(init, dim, rank):
    rng = np.random.default_rng(0)
    basis = np.linalg.qr(rng.normal(size=(dim, dim)))[0]
    x = rng.normal(size=(200, rank)) @ basis[:rank] + 7.0
    gmm = GaussianMixture(2, init_params=init, random_state=0).fit(x)
    assert all_finite(gmm)
    smallest = np.linalg.eigvalsh(gmm.covariances_)[:, : dim - rank]
    np.testing.assert_allclose(smallest, 1e-6, rtol=1e-3)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("init_params", []),
        ("dtype", torch.float64),
        ("weights_init", np.ones(2)),
        ("weights_init", np.array([1.0, -1.0, 1.0])),
        ("weights_init", np.array([1.0, np.nan, 1.0])),
        ("weights_init", np.zeros(3)),
        ("means_init", np.zeros((3, 3))),
        ("means_init", np.full((3, 2), np.inf)),
        ("precisions_init", np.zeros((3, 2))),
        (r"precisions_init\[1\]", np.stack([np.eye(2), -np.eye(2), np.eye(2)])),
    ],
)
def test_invalid_given_starts_are_named(name, value):
    with pytest.raises(InvalidArgumentError, match=name):
        GaussianMixture(**{"n_components": 3, name.partition("\\")[0]: value}).fit(blobs())


# -- samples ---------------------------------------------------------------------------------------


def test_samples_depend_on_the_seed():
    gmm = fitted()
    assert (gmm.sample(5)[0] == gmm.sample(5)[0]).all()
    assert (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=3)[0]).all()
    assert not (gmm.sample(5, random_state=3)[0] == gmm.sample(5, random_state=4)[0]).all()


# -- torch -----------------------------------------------------------------------------------------


def test_mixture_works_as_a_module_of_a_network():
    network = torch.nn.Sequential(torch.nn.Linear(4, 2).double(), fitted())
    points = torch.zeros(5, 4, dtype=torch.float64)
    out = network(points)
    out.sum().backward()
    assert network[0].weight.grad is not None
    other = torch.nn.Sequential(torch.nn.Linear(4, 2).double(), GaussianMixture(3))
    other.load_state_dict(network.state_dict())
    assert torch.equal(other(points), out)


# -- files -----------------------------------------------------------------------------------------


def test_far_float32_points_warn_and_float64_points_do_not():
    points = np.random.default_rng(0).normal(size=(200, 3))
    far = points + 5e5
    with pytest.warns(UserWarning, match=r"float32 and up to 5e\+05.*use float64"):
        GaussianMixture(2, random_state=0).fit(far.astype(np.float32))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        GaussianMixture(2, random_state=0, max_iter=500).fit(far)
        GaussianMixture(2, random_state=0, max_iter=500).fit(points.astype(np.float32))


@pytest.mark.parametrize("scale", [1e-30, 1e-9, 1e15, 1e39, 1e300])
def test_weights_that_lose_digits_are_rejected(scale):
    x = blobs()
    with pytest.raises(InvalidArgumentError, match=r"sample_weight has a mean of .* scale it"):
        GaussianMixture(3).fit(x, sample_weight=np.full(len(x), scale))


@pytest.mark.parametrize("scale", [1e-5, 1e11])
def test_weight_scale_does_not_change_the_fit(scale):
    x = blobs()
    start = given_start(2)
    plain = GaussianMixture(3, **start).fit(x)
    scaled = GaussianMixture(3, **start).fit(x, sample_weight=np.full(len(x), scale))
    np.testing.assert_allclose(scaled.means_, plain.means_, rtol=1e-6)


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
        {"means": MISSING},
        {"covariances": torch.zeros(3, 2, dtype=torch.float64)},
        {"covariances": -torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)},
        {"covariances": torch.tensor([[1.0, 0.9], [-0.9, 1.0]], dtype=torch.float64).repeat(3, 1, 1)},
    ],
    ids=lambda c: next(iter(c)),
)
def test_file_with_invalid_tensors_is_rejected(tmp_path, change):
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(changed_file(fitted(), tmp_path, change))


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
    with pytest.raises(DataError, match=r"m\.safetensors"):
        GaussianMixture.load(changed_file(fitted(), tmp_path, {}, **change))


def test_unknown_parameters_in_a_file_are_ignored(tmp_path):
    parameters = {"n_components": 3, "unheard_of": 1, "tol": 0.5}
    assert GaussianMixture.load(changed_file(fitted(), tmp_path, {}, parameters=parameters)).tol == 0.5


def test_tables_that_are_not_validated_at_length_are_checked_all_the_same():
    x = np.random.default_rng(0).normal(size=(40, 3))
    mixture = GaussianMixture(2, random_state=0).fit(x)
    expected = mixture.score_samples(x)
    for same in (x.tolist(), np.asfortranarray(x), x.astype(">f8"), np.repeat(x, 2, 1)[:, ::2]):
        np.testing.assert_allclose(mixture.score_samples(same), expected)
    for bad in (np.nan, np.inf):
        broken = x.copy()
        broken[3, 1] = bad
        for method in (mixture.score, GaussianMixture(2).fit):
            with pytest.raises(ValueError, match=r"NaN|infinity"):
                method(broken)
    with pytest.raises(ValueError, match="expecting 3 features"):
        mixture.score(x[:, :2].copy())
    large = GaussianMixture(1).fit(np.full((4, 1), 1e308))  # whose sum is not finite
    assert np.isfinite(large.means_).all()
