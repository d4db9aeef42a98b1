"""Calibration: shape of the mapping, the regression against SciPy, merging, and what is refused."""

from __future__ import annotations

import base64
import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize
from torch import Tensor

from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.occupancy import Calibration, Calibrator, Evidence, Prediction, VoxelGrid, probability
from gmmtorch.occupancy import calibrator as module

SIDES = (0.02, 0.1, 0.4)
counts = st.floats(0, 1e9)
sides = st.floats(1e-3, 100.0)
known = st.builds(
    Calibration,
    st.floats(0.05, 500.0),
    st.tuples(*[st.floats(-3, 3) for _ in range(12)]),
    st.integers(0, 10**6),
)


def values(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def reference(c: Calibration, hits: float, misses: float, side: float, dim: int) -> float:
    """The formula of the module's docstring, by plain arithmetic."""
    s = math.log(10) * math.tanh(math.log(side / c.length / 0.05) / math.log(10))
    rows = np.array(c.coefficients).reshape(4, 3)
    a, density, up, down = np.exp(rows @ [1, s, s * s])
    w, n = a * c.length / side, density * side ** (dim - 1)
    z = math.log((w * hits + n) / (misses + n))
    t = down * z + (up - down) * (np.logaddexp(0, z) - math.log(2))
    return 1 / (1 + math.exp(-min(700.0, max(-700.0, t))))


# -- the mapping -----------------------------------------------------------------------------------------


@given(c=known, hits=counts, misses=counts, side=st.floats(0.01, 2.0), dim=st.sampled_from([2, 3]))
def test_probability_is_the_stated_formula(c, hits, misses, side, dim):
    found = float(c.probability(values(hits), values(misses), side, dim))
    assert found == pytest.approx(reference(c, hits, misses, side, dim), rel=1e-9, abs=1e-12)


@settings(max_examples=200)
@given(c=known, pairs=st.lists(st.tuples(counts, counts), min_size=2, max_size=8), side=sides)
def test_probability_is_monotone_and_within_zero_and_one(c, pairs, side):
    hits, misses = (values(*sorted(column)) for column in zip(*pairs, strict=True))
    for dim in (2, 3):
        more_hits = c.probability(hits, misses[:1].expand_as(hits), side, dim)
        more_misses = c.probability(hits[:1].expand_as(misses), misses, side, dim)
        for theta in (more_hits, more_misses):
            assert bool(((theta >= 0) & (theta <= 1)).all())
        assert bool((more_hits.diff() >= -1e-12).all())
        assert bool((more_misses.diff() <= 1e-12).all())


@given(c=known, side=sides, dim=st.sampled_from([2, 3]))
def test_no_evidence_is_exactly_one_half(c, side, dim):
    assert float(c.probability(values(0.0), values(0.0), side, dim)) == 0.5


@pytest.mark.parametrize("dim", [2, 3])
def test_probability_is_smooth_in_the_side(dim):
    c = Calibration.prior(8.0)
    side = np.geomspace(1e-3, 50.0, 4001)
    theta = np.array([float(c.log_odds(values(3.0), values(40.0), float(h), dim)) for h in side])
    slope = np.diff(theta) / np.diff(np.log(side))
    assert np.abs(np.diff(slope)).max() < 0.02  # no kink


def test_gradients_agree_with_differences():
    c = Calibration.prior(5.0)
    hits, misses = values(0.3, 5.0, 0.01).requires_grad_(), values(2.0, 0.1, 30.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda h, m: c.probability(h, m, 0.1, 3), (hits, misses))


def test_prior_of_more_distant_beams_makes_a_hit_count_more():
    near, far = (Calibration.prior(r).log_odds(values(1.0), values(20.0), 0.1, 3) for r in (2.0, 20.0))
    assert float(far) > float(near)


@pytest.mark.parametrize("mean_range", [0.0, -1.0, math.nan, math.inf])
def test_prior_refuses_a_range_that_is_no_length(mean_range):
    with pytest.raises(InvalidArgumentError, match="mean_range"):
        Calibration.prior(mean_range)


# -- text and merging ------------------------------------------------------------------------------------


@given(
    mean_range=st.floats(0.1, 500.0),
    shifts=st.tuples(*[st.floats(-1, 1) for _ in range(12)]),
    n=st.integers(0, 10**9),
)
def test_text_restores_a_learned_calibration(mean_range, shifts, n):
    start = Calibrator.of(mean_range, len(SIDES))
    learned = Calibrator(
        start.length, start.mean + torch.tensor(shifts).double(), start.precision, start.tally, n
    ).calibration
    text = learned.text()
    assert len(text) == 35
    again = Calibration.read(text)
    assert again == learned
    assert again.text() == text
    assert learned.n_predicted == pytest.approx(n, rel=2e-2, abs=0.5)


def bytes_of(*numbers: float) -> str:
    return base64.b85encode(np.array(numbers, "<f2").tobytes()).decode()


@pytest.mark.parametrize(
    "text",
    [
        None,
        7,
        "",
        "!",
        "A" * 34,
        "A" * 40,
        bytes_of(*[math.nan] * 14),
        bytes_of(*[0.0] * 13, math.inf),
        bytes_of(*[0.0] * 13, 60000.0),
        bytes_of(0.0, -1.0, *[0.0] * 12),
    ],
)
def test_a_damaged_text_is_refused(text):
    with pytest.raises(DataError, match=r"calibration=.*remove it"):
        Calibration.read(text)


def test_merging_is_the_weighted_mean_in_any_order():
    parts = [
        Calibration(r, tuple(float(x) for x in np.arange(12) * scale), n)
        for r, scale, n in ((2.0, 0.25, 100), (8.0, 0.5, 300), (4.0, 0.0, 0))
    ]
    found = {Calibration.merged(order) for order in itertools.permutations(parts)}
    assert len(found) == 1
    (merged,) = found
    weights = np.array([100, 300, 1]) / 401
    assert merged.length == pytest.approx(math.exp(weights @ np.log([2.0, 8.0, 4.0])), rel=2e-3)
    np.testing.assert_allclose(merged.coefficients, np.arange(12) * (weights @ [0.25, 0.5, 0.0]), rtol=2e-3)
    assert merged.n_predicted == pytest.approx(400, rel=1e-2)
    assert Calibration.merged([merged]) == merged


# -- learning --------------------------------------------------------------------------------------------


def drawn(truth: Calibration, n: int, seed: int, dim: int = 3) -> list[Prediction]:
    """Places whose state is drawn with the probabilities of a calibration."""
    generator = torch.Generator().manual_seed(seed)
    found = []
    for side in SIDES:
        hits = 10 ** (4 * torch.rand(n, generator=generator, dtype=torch.float64) - 3)
        misses = 10 ** (4 * torch.rand(n, generator=generator, dtype=torch.float64) - 2)
        theta = truth.probability(hits, misses, side, dim)
        found.append(Prediction(hits, misses, torch.rand(n, generator=generator).double() < theta, side))
    return found


def test_an_update_is_the_penalised_maximum_likelihood():
    start = Calibrator.of(6.0, len(SIDES))
    seen = drawn(Calibration.prior(15.0), 400, 0)
    deviation = np.asarray(module._DEVIATION.flatten())

    def loss(x: np.ndarray) -> float:
        total = 0.5 * (((x - start.mean.numpy()) / deviation) ** 2).sum()
        for p in seen:
            c = Calibration(start.length, tuple(x))
            t = c.log_odds(p.hits, p.misses, p.side, 3).numpy()
            sign = np.where(p.occupied.numpy(), -1, 1)
            total += module._INDEPENDENT * np.logaddexp(0, sign * t).sum()
        return total

    best = minimize(loss, start.mean.numpy(), method="BFGS")
    found = start.updated(seen, 3)
    assert loss(found.mean.numpy()) - best.fun < 0.02 * (loss(start.mean.numpy()) - best.fun)
    np.testing.assert_allclose(found.mean.numpy(), best.x, atol=0.15 * deviation.max())


def test_learning_recovers_another_sensor_and_its_probabilities_are_shares():
    usual = Calibration.prior(6.0).coefficients
    truth = Calibration(3.0, (*usual[:6], -0.3, 0.1, 0.0, -0.4, 0.1, 0.0))
    learned = Calibrator.of(6.0, len(SIDES))
    for window in range(60):
        learned = learned.updated(drawn(truth, 60, window), 3)
    before, after = Calibration.prior(6.0), learned.calibration
    for test in drawn(truth, 20_000, 999):
        right = truth.probability(test.hits, test.misses, test.side, 3)
        errors = [
            float((c.probability(test.hits, test.misses, test.side, 3) - right).abs().mean())
            for c in (before, after)
        ]
        assert errors[1] < 0.02
        assert errors[1] < 0.5 * errors[0]


def test_a_sensor_that_changes_is_followed():
    first, second = Calibration.prior(6.0), Calibration.prior(6.0)
    second = second._replace(coefficients=(*second.coefficients[:6], -0.4, 0.1, 0.0, -0.4, 0.1, 0.0))
    learned = Calibrator.of(6.0, len(SIDES))
    for window in range(40):
        learned = learned.updated(drawn(first, 60, window), 3)
    errors = []
    for window in range(120):
        learned = learned.updated(drawn(second, 60, 100 + window), 3)
        test = drawn(second, 4000, 5)[1]
        right = second.probability(test.hits, test.misses, test.side, 3)
        found = learned.calibration.probability(test.hits, test.misses, test.side, 3)
        errors.append(float((found - right).abs().mean()))
    assert errors[-1] < 0.4 * errors[0]


@given(st.integers(0, 10_000), st.sampled_from([2, 3]))
def test_derivatives_by_the_coefficients_are_those_of_automatic_differentiation(seed, dim):
    draw = torch.Generator().manual_seed(seed)
    hits, misses = torch.rand(2, 20, generator=draw).double() * torch.tensor([[3.0], [90.0]])
    side = 0.01 + torch.rand(20, generator=draw).double()
    mean = torch.from_numpy(module._MEAN.flatten()) + 0.3 * torch.randn(12, generator=draw).double()
    length = 2.5

    def log_odds(mean: Tensor) -> Tensor:
        scale = module._WIDTH * ((side / length / module._CENTER).log() / module._WIDTH).tanh()
        a, density, up, down = (mean.view(4, 3) @ torch.stack([scale**0, scale, scale**2])).exp()
        least = density * side ** (dim - 1)
        z = ((hits * a * length / side + least) / (misses + least)).log()
        return down * z + (up - down) * (torch.nn.functional.softplus(z, threshold=100) - math.log(2))

    expected = torch.autograd.functional.jacobian(log_odds, mean).T
    given_ = (value.numpy() for value in (hits, misses, side))
    value, found = module._derivatives(*given_, length, dim, mean.numpy())
    np.testing.assert_allclose(value, log_odds(mean).numpy(), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found, expected.numpy(), rtol=1e-9, atol=1e-11)


def test_contradictions_stay_within_the_bounds_of_the_prior():
    start = Calibrator.of(6.0, len(SIDES))
    learned = start
    for window in range(200):
        wrong = [p._replace(occupied=~p.occupied) for p in drawn(Calibration.prior(6.0), 200, window)]
        learned = learned.updated(wrong, 3)
    moved = (learned.mean - start.mean).abs() / torch.from_numpy(module._DEVIATION.flatten())
    assert float(moved.max()) <= module._FARTHEST + 1e-9
    theta = learned.calibration.probability(values(0.0, 5.0), values(0.0, 0.0), 0.1, 3)
    assert float(theta[0]) == 0.5
    assert float(theta[1]) > 0.5


def test_the_tally_counts_each_prediction_in_its_bin():
    start = Calibrator.of(6.0, len(SIDES))
    seen = drawn(Calibration.prior(6.0), 500, 3)
    tally = start.updated(seen, 3).tally
    for number, p in enumerate(seen):
        theta = start.calibration.probability(p.hits, p.misses, p.side, 3)
        assert float(tally[number, :, 0].sum()) == 500
        assert float(tally[number, :, 1].sum()) == pytest.approx(float(theta.sum()), rel=1e-3)
        assert float(tally[number, :, 2].sum()) == float(p.occupied.sum())


def test_a_continued_calibrator_keeps_the_calibration_and_learns_on():
    learned = Calibrator.of(6.0, len(SIDES)).updated(drawn(Calibration.prior(15.0), 400, 0), 3)
    again = Calibrator.continued(learned.calibration, len(SIDES))
    assert again.calibration == learned.calibration
    further = again.updated(drawn(Calibration.prior(15.0), 400, 1), 3)
    assert further.calibration.n_predicted > again.n_predicted
    assert Calibrator.restored(vars(learned)).calibration == learned.calibration


@pytest.mark.parametrize(
    "change", [{"mean": torch.zeros(3)}, {"length": -1.0}, {"precision": torch.full((12, 12), math.nan)}]
)
def test_a_damaged_state_is_refused(change):
    state = {**vars(Calibrator.of(6.0, len(SIDES))), **change}
    with pytest.raises(ValueError, match=r"damaged|length"):
        Calibrator.restored(state)


# -- the rule of evidence --------------------------------------------------------------------------------


def test_evidence_says_by_which_rule_its_probabilities_follow():
    grid = VoxelGrid((0.0, 0.0), 0.1, (2, 2))
    hits, misses = torch.rand(2, 2).double(), torch.rand(2, 2).double()
    known = Calibration.prior(4.0)
    rays, ours = Evidence(grid, hits, misses), Evidence(grid, hits, misses, known)
    learned = Evidence(grid, hits, misses, known._replace(n_predicted=12))
    assert "prior 1" in repr(rays)
    assert "sensor model alone" in repr(ours)
    assert "12 predictions" in repr(learned)
    torch.testing.assert_close(rays.probability(), (hits + 1) / (hits + misses + 2))
    assert torch.equal(ours.probability(), probability(hits, misses, 0.1, 2, known))
    torch.testing.assert_close(ours.probability(prior=1.0), rays.probability())
