"""Tests that every mixture estimator passes: inherit `MixtureContract` and implement `make`."""

from __future__ import annotations

import copy
import inspect
import math
import pickle
from typing import Any, ClassVar

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mixture.fit_contract import FitContract, blobs, kinds, move, rigid_motion
from sklearn.base import clone

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError, MissingDataError
from gmmtorch.files import pack_tensors, read_tensors
from gmmtorch.mixture import MixtureEstimator, NotFittedError

BAD_PARAMETERS: dict[str, tuple[Any, ...]] = {
    "n_components": (0, -1, 1.5, "many"),
    "random_state": (-1, 1.5, "seed", 2**64),
    "max_iter": (-1, 2.5, "long"),
    "n_init": (0, -1),
    "tol": (-1e-3, math.nan, "small"),
    "reg_covar": (-1.0, math.inf, None),
    "init_params": ("unheard_of", None),
    "dtype": ("float16", None),
}
"""Invalid values of the options of estimators that have them."""


class MixtureContract(FitContract):
    """Of an estimator: its fits, and its interface, which does not depend on how it fits."""

    bad_parameters: ClassVar[dict[str, tuple[Any, ...]]] = {}
    """Invalid values of constructor options besides `BAD_PARAMETERS`; the error must name the option."""

    # -- the fitted mixture ------------------------------------------------------------------------------

    def test_predict_is_the_largest_responsibility(self):
        points = blobs(2)
        mixture = self.make().fit(points)
        share = mixture.predict_proba(points)
        assert share.shape == (len(points), len(mixture.weights_))
        np.testing.assert_allclose(share.sum(1), 1, rtol=1e-12)
        assert (mixture.predict(points) == share.argmax(1)).all()

    def test_samples_have_the_moments_of_the_mixture(self):
        mixture = self.make().fit(blobs(2))
        points, labels = mixture.sample(4000, random_state=0)
        assert points.shape == (4000, 2)
        share = np.bincount(labels, minlength=len(mixture.weights_)) / 4000
        np.testing.assert_allclose(share, mixture.weights_, atol=0.05)
        np.testing.assert_allclose(points.mean(0), mixture.weights_ @ mixture.means_, atol=0.2)

    def test_queries_before_fit_raise_not_fitted(self):
        mixture = self.make()
        for ask in (lambda: mixture.score_samples(blobs(2)), mixture.sample, mixture.n_parameters):
            with pytest.raises(NotFittedError, match="fit"):
                ask()

    # -- arrays and tensors ------------------------------------------------------------------------------

    @pytest.mark.parametrize("dtype", [np.float32, np.float64])
    @kinds
    def test_queries_have_the_kind_of_the_points_and_their_precision(self, kind, dtype):
        points = kind(blobs(2).astype(dtype))
        mixture = self.make().fit(points)
        for value in (mixture.weights_, mixture.means_, mixture.covariances_, mixture.precisions_):
            assert type(value) is type(points)
            assert value.dtype == kind(np.zeros(1)).dtype
        for value in (mixture.score_samples(points), mixture.predict_proba(points)):
            assert type(value) is type(points)
            assert value.dtype == points.dtype
        assert type(mixture.predict(points)) is type(mixture.sample(2)[0]) is type(points)

    def test_tensors_and_arrays_give_equal_fits(self):
        points = blobs(3)
        array, tensor = self.make().fit(points), self.make().fit(torch.from_numpy(points))
        assert torch.equal(array.means, tensor.means)
        assert torch.equal(array.covariances, tensor.covariances)

    # -- weights -----------------------------------------------------------------------------------------

    @kinds
    def test_invalid_weights_are_named(self, kind):
        for weight in (
            [1.0, -1.0, 1.0, 1.0],
            [1.0, math.nan, 1.0, 1.0],
            [1.0, math.inf, 1.0, 1.0],
            [0.0] * 4,
            [1.0] * 3,
            [[1.0] * 4],
        ):
            with pytest.raises(InvalidArgumentError, match="sample_weight"):
                self.make(1).fit(kind(blobs(2, 4)), sample_weight=kind(np.array(weight)))

    # -- invalid and degenerate clouds -------------------------------------------------------------------

    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_non_finite_points_are_named(self, value):
        points = blobs(2)
        points[7, 1] = value
        with pytest.raises(ValueError, match=r"NaN|infinity"):
            self.make().fit(points)
        with pytest.raises(InvalidArgumentError, match=r"X\[7\]"):
            self.make().fit(torch.from_numpy(points))
        mixture = self.make().fit(blobs(2))
        with pytest.raises(InvalidArgumentError, match=r"X\[7\]"):
            mixture.score_samples(torch.from_numpy(points))

    @kinds
    def test_input_of_another_shape_is_rejected(self, kind):
        for x in (
            np.empty((0, 2)),
            np.empty((4, 0)),
            np.zeros(4),
            np.zeros((4, 2, 2)),
            np.zeros((4, 2), complex),
        ):
            with pytest.raises(ValueError, match=r"X |array|[Cc]omplex"):
                self.make(1).fit(kind(x))
        mixture = self.make().fit(kind(blobs(2)))
        with pytest.raises(ValueError, match="3 features"):
            mixture.score_samples(kind(blobs(3)))

    # -- parameters --------------------------------------------------------------------------------------

    def test_invalid_parameters_are_named(self):
        usual = {name: BAD_PARAMETERS[name] for name in BAD_PARAMETERS.keys() & self.make().get_params()}
        for name, values in [*usual.items(), *self.bad_parameters.items()]:
            for value in values:
                with pytest.raises(InvalidArgumentError, match=name):
                    self.make(**{name: value}).fit(blobs(2))

    def test_every_parameter_is_stored_and_documented(self):
        mixture = self.make()
        signature = inspect.signature(type(mixture).__init__).parameters
        assert set(mixture.get_params()) == set(signature) - {"self"}
        assert all(name in (type(mixture).__doc__ or "") for name in mixture.get_params())

    def test_clone_is_unfitted_and_gives_the_same_fit(self):
        mixture = self.make().fit(blobs(2))
        other = clone(mixture)
        assert not hasattr(other, "means")
        assert other.get_params() == mixture.get_params()
        assert torch.equal(other.fit(blobs(2)).means, mixture.means)

    # -- motions, copies and files -----------------------------------------------------------------------

    @pytest.mark.parametrize("dim", [2, 3])
    @kinds
    def test_moved_mixture_has_equal_scores_at_moved_points(self, dim, kind):
        points, motion = blobs(dim), rigid_motion(dim)
        mixture = self.make().fit(kind(points))
        before = mixture.means.clone()
        moved = mixture.moved(motion)
        assert type(moved) is type(mixture)
        assert type(moved.means_) is type(mixture.means_)
        expected = mixture.score_samples(kind(points))
        np.testing.assert_allclose(moved.score_samples(kind(move(motion, points))), expected, atol=1e-8)
        assert torch.equal(mixture.means, before)
        assert moved.get_params() == mixture.get_params()
        assert moved.lower_bounds_ == mixture.lower_bounds_
        assert moved.state_dict().keys() == mixture.state_dict().keys()
        self.same(mixture.moved(np.eye(dim + 1)), mixture)
        with pytest.raises(InvalidArgumentError, match="transform"):
            mixture.moved(2 * motion)

    def test_unfitted_mixture_has_no_fitted_attributes(self, tmp_path):
        for name in ("means_", "weights_", "covariances_", "precisions_", "lower_bound_"):
            assert not hasattr(self.make(), name)
        with pytest.raises(NotFittedError):
            self.make().save(tmp_path / "m.safetensors")
        assert list(tmp_path.iterdir()) == []

    def same(self, other: MixtureEstimator, mixture: MixtureEstimator) -> None:
        """Check that both mixtures are equal to the bit."""
        assert type(other) is type(mixture)
        mine, state = other.state_dict(), mixture.state_dict()
        assert mine.keys() == state.keys()
        assert all(torch.equal(mine[name], state[name]) for name in state)
        assert type(other.means_) is type(mixture.means_)
        for name in ("lower_bounds_", "lower_bound_", "n_iter_", "converged_", "n_features_in_"):
            assert getattr(other, name) == getattr(mixture, name)
        assert getattr(other, "n_samples_seen_", None) == getattr(mixture, "n_samples_seen_", None)
        assert other.get_params() == mixture.get_params()
        points = blobs(mixture.n_features_in_, 20, seed=2)
        assert (other.score_samples(points) == mixture.score_samples(points)).all()

    @kinds
    def test_copies_are_equal(self, kind):
        mixture = self.make().fit(kind(blobs(2)))
        for other in (copy.deepcopy(mixture), pickle.loads(pickle.dumps(mixture))):
            assert other is not mixture
            self.same(other, mixture)
        assert not hasattr(copy.deepcopy(self.make()), "means")

    @kinds
    def test_load_restores_what_save_wrote(self, tmp_path, kind):
        path = tmp_path / "m.safetensors"
        mixture = self.make().fit(kind(blobs(3)))
        mixture.save(path)
        loaded = type(mixture).load(path)
        self.same(loaded, mixture)
        loaded.save(tmp_path / "again.safetensors")
        assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()
        self.same(loaded.moved(np.eye(4)).fit(kind(blobs(3))), mixture)

    def test_moved_mixture_can_be_saved(self, tmp_path):
        mixture = self.make().fit(blobs(2)).moved(rigid_motion(2))
        mixture.save(tmp_path / "m.safetensors")
        self.same(type(mixture).load(tmp_path / "m.safetensors"), mixture)

    def test_missing_foreign_and_truncated_files_are_named(self, tmp_path):
        mixture = self.make().fit(blobs(2))
        path = tmp_path / "m.safetensors"
        with pytest.raises(MissingDataError, match=r"m\.safetensors"):
            type(mixture).load(path)
        mixture.save(path)
        data = path.read_bytes()
        for wrong in (
            pack_tensors({}, "gmmtorch.other", 1),
            b"",
            *(data[:n] for n in range(0, len(data), 37)),
        ):
            path.write_bytes(wrong)
            with pytest.raises(DataError, match=r"m\.safetensors"):
                type(mixture).load(path)

    def test_a_file_with_numbers_beyond_float64_is_refused(self, tmp_path):
        path = tmp_path / "m.safetensors"
        mixture = self.make().fit(blobs(2))
        mixture.save(path)
        tensors, facts = read_tensors(path, "gmmtorch.mixture", 1)
        path.write_bytes(pack_tensors(tensors, "gmmtorch.mixture", 1, **{**facts, "lower_bounds": [10**400]}))
        with pytest.raises(DataError, match=r"m\.safetensors"):
            type(mixture).load(path)

    @settings(max_examples=60)
    @given(place=st.floats(0, 1, exclude_max=True), value=st.integers(0, 255), in_header=st.booleans())
    def test_damaged_file_is_rejected_or_valid(self, tmp_path, place, value, in_header):
        path = tmp_path / "sound.safetensors"
        if not path.exists():
            self.make().fit(blobs(2)).save(path)
        data = bytearray(path.read_bytes())
        end = 8 + int.from_bytes(data[:8], "little") if in_header else len(data)
        data[int(place * end)] = value
        (tmp_path / "damaged.safetensors").write_bytes(data)
        try:
            loaded = type(self.make()).load(tmp_path / "damaged.safetensors")
        except GmmTorchError:
            return
        assert np.isfinite(loaded.score_samples(np.zeros((2, 2)))).all()

    def test_state_dict_restores_an_unfitted_mixture(self):
        mixture, other = self.make().fit(torch.from_numpy(blobs(3))), self.make()
        other.load_state_dict(mixture.state_dict())
        points = torch.from_numpy(blobs(3, 20, seed=2))
        assert torch.equal(other(points), mixture(points))
        assert list(mixture.parameters()) == []

    def test_cast_of_the_module_keeps_float64_parameters(self):
        mixture = self.make().fit(blobs(2)).to(torch.float16)
        assert all(value.dtype != torch.float16 for value in mixture.state_dict().values())
