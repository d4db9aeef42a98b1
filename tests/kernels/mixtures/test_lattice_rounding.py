"""Rounding to the codec's lattice: the fused kernel against its twin, to the bit."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernels.twins import by_both
from mapping.random_components import random_components
from torch import Tensor

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.kernels import kernels
from gmmtorch.mapping.codec import lattice
from gmmtorch.mapping.codec.lattice import Lattice

pytestmark = pytest.mark.cpu_only


def rounded_by_both(means: Tensor, covariances: Tensor, coarse: bool = False) -> Lattice:
    """The lattice points of the fused kernel, after a comparison with those of the twin."""
    twin, fused = by_both(lambda: lattice.nearest(means, covariances, coarse))
    for field in fields(Lattice):
        assert torch.equal(getattr(fused, field.name), getattr(twin, field.name)), field.name
    with kernels("torch"):
        expected = twin.restored()
    with kernels("fused"):
        assert all(map(torch.equal, fused.restored(), expected))
    return fused


@settings(max_examples=100)
@given(
    k=st.integers(0, 40),
    dim=st.sampled_from([2, 3]),
    seed=st.integers(0, 10**6),
    center=st.sampled_from([0.0, -3.7, 4.2e6]),
    deviations=st.sampled_from([(1e-9, 1e4), (5e-3, 1.0), (0.1, 0.1), (20.0, 5e3)]),
    shape=st.sampled_from(["any", "indefinite", "along the axes", "flat", "zero"]),
    coarse=st.booleans(),
)
def test_rounded_components_are_those_of_the_twin_to_the_bit(k, dim, seed, center, deviations, shape, coarse):
    drawn = random_components(
        dim, k, seed, center=center, extent=30.0, deviations=deviations, counts=(1.0, 100.0), n_origins=3
    )
    means, covariances = drawn.means, drawn.covariances
    if shape == "indefinite":
        noise = torch.randn(k, dim, dim, generator=torch.Generator().manual_seed(seed)).double()
        covariances = covariances + 0.1 * (noise + noise.mT) * covariances.abs().sum() / max(k, 1)
    elif shape == "along the axes":  # many axis orders restore the same component
        covariances = torch.diag_embed(covariances.diagonal(dim1=1, dim2=2))
    elif shape == "flat":
        covariances = covariances[:, :, :1] @ covariances[:, :1, :] / covariances[:, :1, :1].clamp_min(1e-30)
    elif shape == "zero":
        covariances = torch.zeros_like(covariances)
    once = rounded_by_both(means, covariances, coarse)
    again = rounded_by_both(*once.restored(), coarse)
    assert all(torch.equal(getattr(once, f.name), getattr(again, f.name)) for f in fields(Lattice))


@pytest.mark.parametrize("value", [float("nan"), 1e30, float("-inf")])
def test_values_out_of_bounds_have_the_errors_of_the_twin(value):
    means, covariances = torch.zeros(3, 2).double(), torch.eye(2).double().repeat(3, 1, 1)
    means[1, 0] = value
    messages = []
    for choice in ("fused", "torch"):
        with kernels(choice), pytest.raises(InvalidArgumentError, match=r"means\[1\]") as caught:
            lattice.nearest(means, covariances)
        messages.append(str(caught.value))
    assert messages[0] == messages[1]


@pytest.mark.parametrize("order", [-1, 6, 1 << 40])
def test_axis_orders_that_do_not_exist_are_restored_beyond_all_bounds(order):
    places = lattice.nearest(torch.zeros(1, 3).double(), torch.eye(3).double()[None])
    with kernels("fused"):
        means, covariances = replace(places, axis_order=torch.tensor([order])).restored()
    assert means.isinf().all()
    assert covariances.isinf().all()


def test_steps_of_deviations_are_rounded_logarithms():
    variances = torch.tensor(np.geomspace(1e-14, 1e13, 100_001))
    expected = np.round(np.log2(variances.numpy()) * lattice.PER_OCTAVE / 2)
    assert lattice._deviation_steps(variances, coarse=False).tolist() == expected.tolist()
