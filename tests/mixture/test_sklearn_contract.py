"""GaussianMixture passes scikit-learn's own checks of an estimator, as far as they apply."""

from __future__ import annotations

from typing import Any

import pytest
from sklearn.utils.estimator_checks import estimator_checks_generator

from gmmtorch.mixture import GaussianMixture

EXPECTED_FAILURES = {
    "check_no_attributes_set_in_init": "nn.Module sets its own attributes in __init__",
}
"""Checks that must fail, and why. The test fails if such a check passes."""


class WithoutMotion(GaussianMixture):
    """A GaussianMixture without `transform`.

    `transform` moves a fitted mixture by a rigid motion. scikit-learn would treat it as a feature
    transformer and call it with points.
    """

    @property
    def transform(self) -> Any:
        raise AttributeError("transform")


CHECKS = [
    (estimator, check)
    for estimator, check in estimator_checks_generator(WithoutMotion(), mark=None, legacy=True)
]


def name_of(check: Any) -> str:
    return getattr(check, "func", check).__name__


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("estimator", "check"), CHECKS, ids=[f"{i}-{name_of(check)}" for i, (_, check) in enumerate(CHECKS)]
)
def test_scikit_learn_check(estimator, check):
    if name_of(check) in EXPECTED_FAILURES:
        with pytest.raises(AssertionError):
            check(estimator)
    else:
        check(estimator)


def test_expected_failures_are_existing_checks():
    assert EXPECTED_FAILURES.keys() <= {name_of(check) for _, check in CHECKS}
    assert len(CHECKS) > 30
