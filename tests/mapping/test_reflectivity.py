"""Reflectivity: intensities of a simulated sensor whose law is known."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from mapping.map_cases import FINE, drive
from mapping.test_attributes import painted
from torch import Tensor

import gmmtorch as gt
from gmmtorch import IncrementalRule, Scan, WindowedRule
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.learning.rules import IntensityLaw, read_rule, rule_facts

RANGE, INCIDENCE = -1.6, 0.8
ROOM = torch.tensor([12.0, 8.0, 3.0], dtype=torch.float64)


def seen_from(x: float, seed: int, n: int = 4000, noise: float = 0.05) -> Scan:
    """A scan of a room with squares of 4 m of reflectivity 20 and 60 at 1 m, by hand."""
    generator = torch.Generator().manual_seed(seed)
    origin = torch.tensor([x, 3.0 + 0.2 * x, 1.2]).double()
    ray = torch.nn.functional.normalize(torch.randn(n, 3, generator=generator).double())
    walls = torch.where(ray > 0, (ROOM - origin) / ray, -origin / ray)
    distance, axis = walls.min(1)
    cosine = ray.gather(1, axis[:, None])[:, 0].abs()
    points = origin + ray * distance[:, None]
    error = noise * torch.randn(n, generator=generator).double()
    value = painted_walls(points, axis) * distance**RANGE * cosine**INCIDENCE * torch.exp(error)
    return Scan(
        points + 0.002 * torch.randn(n, 3, generator=generator), origin, attributes={"intensity": value}
    )


def painted_walls(points: Tensor, axis: Tensor) -> Tensor:
    square = (points / 4).floor().scatter(1, axis[:, None], 0.0).sum(1) % 2
    return 20 + 40 * square


def built(rule: gt.GaussianMap | WindowedRule | IncrementalRule) -> gt.GaussianMap:
    made = gt.GaussianMap(rule)
    for i in range(16):
        made.insert(seen_from(1 + 0.4 * i, i))
    return made


RULES = [IncrementalRule(length=0.5, window=8), WindowedRule(length=0.4, window=8)]


@pytest.mark.parametrize("rule", RULES)
def test_the_law_of_the_sensor_is_found_and_predicts_from_elsewhere(rule, tmp_path):
    made, plain = built(replace(rule, reflectivity=True)), built(rule)
    law = made.learning.reflectivity
    assert law.exponents == pytest.approx((RANGE, INCIDENCE), abs=0.1)
    other = seen_from(10.5, 99, noise=0.0)  # 3.5 m beyond the last place of the others
    truth = other.attributes["intensity"][:, 0]
    found = made.attributes(other.points, seen_from=other.origin)["intensity"].mean[:, 0]
    without = plain.attributes(other.points)["intensity"].mean[:, 0]
    errors = [float((value.clamp_min(1e-9) / truth).log().abs().median()) for value in (found, without)]
    assert errors[0] < 0.12 < 0.4 < errors[1]
    here = made.attributes(other.points)["intensity"].mean[:, 0]  # at the range r₀, facing the sensor
    on_floor = other.points[:, 2] < 0.05
    axis = torch.full((int(on_floor.sum()),), 2)
    wanted = painted_walls(other.points[on_floor], axis) * law.reference**RANGE
    assert float((here[on_floor] / wanted).log().abs().median()) < 0.15
    made.save(tmp_path / "map")
    loaded = gt.GaussianMap.load(tmp_path / "map")
    again = loaded.attributes(other.points, seen_from=other.origin)["intensity"].mean[:, 0]
    torch.testing.assert_close(again, found)
    copy = gt.GaussianMap(rule)
    copy.load_state_dict(made.state_dict())
    assert copy.learning == made.learning


def test_only_the_intensity_changes_and_only_if_asked_for():
    one, other = (gt.GaussianMap(replace(FINE, reflectivity=on)) for on in (False, True))
    for made in (one, other):
        for seed, scan in enumerate(drive(6)):
            made.insert(painted(scan, seed))
    assert "reflectivity" not in rule_facts(one.learning)
    assert torch.equal(one.means, other.means)
    for name, value in one.unrounded().attributes.tensors().items():
        is_same = torch.equal(value, other.unrounded().attributes.tensors()[name])
        assert is_same == (name not in ("intensity.mean", "intensity.slope", "intensity.covariance"))


def test_beams_that_do_not_tell_range_and_incidence_apart_give_small_exponents():
    """One wall seen from one place: log cos = log h − log r. Only the difference of exponents is known."""
    law = IntensityLaw(1.0, 1000, 10.0, -10.0, 10.0, -24.0, 24.0, 60.0)
    a, b = law.exponents
    assert a - b == pytest.approx(-2.4, abs=0.01)
    assert (a, b) == pytest.approx((-1.2, 1.2), abs=0.01)
    assert IntensityLaw(1.0, 0, 0, 0, 0, 0, 0, 0).exponents == (0.0, 0.0)


def test_intensities_that_have_no_logarithm_do_not_count():
    scans = [seen_from(1 + 0.4 * i, i) for i in range(8)]
    dark = [
        replace(s, attributes={"intensity": s.attributes["intensity"] * (s.points[:, 2:] < 2.9)})
        for s in scans
    ]
    none = [replace(s, attributes={"intensity": torch.zeros(len(s.points))}) for s in scans]
    for given, known in ((dark, True), (none, False)):
        made = gt.GaussianMap(replace(RULES[0], reflectivity=True))
        for scan in given:
            made.insert(scan)
        assert isinstance(made.learning.reflectivity, IntensityLaw) == known
        ceiling = made.attributes([[6.3, 3.3, 3.0]])["intensity"]
        assert float(ceiling.mean) == pytest.approx(0.0, abs=0.02)


def test_what_a_law_cannot_be_is_an_error():
    for wrong in (1, "on", (1.0, 2.0), IntensityLaw(0.0, 1, 1, 1, 1, 1, 1, 1)):
        with pytest.raises(InvalidArgumentError, match="reflectivity="):
            IncrementalRule(reflectivity=wrong)
    rule = IncrementalRule(reflectivity=IntensityLaw(5.0, 10, 1, 0.5, 1, -1, 1, 4))
    assert read_rule(**rule_facts(rule)) == rule
    plain = built(RULES[0])
    with pytest.raises(InvalidArgumentError, match="reflectivity=True"):
        plain.attributes(torch.zeros(1, 3), seen_from=torch.zeros(3))
    made = gt.GaussianMap(replace(RULES[0], reflectivity=True))
    scan = seen_from(1, 0)
    with pytest.raises(InvalidArgumentError, match="one number for each point"):
        made.insert(replace(scan, attributes={"intensity": torch.zeros(len(scan.points), 2)}))
    made.insert(scan)
    for bad in (torch.zeros(2), torch.full((3,), torch.nan), torch.zeros(5, 3)):
        with pytest.raises(InvalidArgumentError, match="seen_from has shape"):
            made.attributes(torch.zeros(1, 3), seen_from=bad)
