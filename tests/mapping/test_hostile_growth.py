"""Maps that grow from unusual input: a robot that stays, components of extreme shape, places far apart."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from mapping.map_cases import FINE, built, given_parts, open_drive
from mapping.test_growing_tiles import around, street
from occupancy.protocol_contract import shifted
from torch import Tensor

from gmmtorch.mapping import GaussianMap, IncrementalRule, TiledMap, WindowedRule
from gmmtorch.mapping import query as map_query
from gmmtorch.mapping.tiles import tiled_map
from gmmtorch.occupancy import point_evidence
from gmmtorch.scan import Scan


def test_a_million_hits_from_one_place_are_a_small_map(generator):
    made, origin = GaussianMap(IncrementalRule(window=5)), torch.zeros(3, dtype=torch.float64)
    for _ in range(20):
        wall = 4 * torch.rand(50_000, 3, generator=generator, dtype=torch.float64) - 2
        wall[:, 0] = 5 + 0.01 * torch.randn(50_000, generator=generator, dtype=torch.float64)
        made.insert(Scan(wall, origin))
        answer = made.occupancy(torch.tensor([[5.0, 0.3, 0.2], [2.0, 0.1, 0.1], [9.0, 0, 0]]).double())
        assert answer[0] > 0.6 > 0.4 > answer[1]
        assert answer[2] == pytest.approx(0.5, abs=0.1)
    found = made.components()
    assert len(found) < 1000
    assert len(found.origins) == 1
    assert float(made.unrounded().support.sum()) == pytest.approx(1e6)
    assert len(made.unrounded().origins) <= 20
    assert made.nbytes < 16_000


def given_case(case: str) -> tuple[dict[str, Tensor], list[list[tuple[Tensor, float]]] | Tensor]:
    """Arguments of `from_components`: the components, and their origins."""
    parts = given_parts(3, 60)
    origins: list[list[tuple[Tensor, float]]] | Tensor = parts.pop("origins")
    if case == "clusters":
        far = torch.arange(60)[:, None] % 2 * 1e6
        parts["means"], origins = parts["means"] + far, origins + far
    elif case == "hundred metres":
        parts["covariances"][7] = torch.diag(torch.tensor([100.0, 50.0, 0.01]).double()) ** 2
    elif case == "needles":
        parts["covariances"] = torch.diag(torch.tensor([5.0, 1e-4, 1e-4]).double() ** 2).repeat(60, 1, 1)
    else:
        generator = torch.Generator().manual_seed(1)
        many = 4 * torch.randn(3000, 3, generator=generator, dtype=torch.float64)
        origins = [[(one, 1.0)] for one in origins]
        origins[3] = [(one, 1.0) for one in many]
    return parts, origins


@pytest.mark.parametrize("case", ["clusters", "hundred metres", "needles", "thousands of origins"])
@pytest.mark.parametrize("block", [7, 8192])
def test_strange_components_answer_as_all_of_their_cones(case, block, monkeypatch):
    monkeypatch.setattr(map_query, "_BLOCK", block)
    parts, origins = given_case(case)
    made = GaussianMap.from_components(**parts, origins=origins, cutoff=4.0)
    cones = made.components().cones()
    share = torch.rand(len(cones.counts), 1, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    asked = (cones.origins + share * (cones.means - cones.origins))[:: 1 + len(share) // 200]
    asked = torch.cat([asked, cones.means[:9], torch.full_like(asked[:1], torch.inf), asked[:1] - 3e8])
    theta = made.occupancy(asked)
    evidence = point_evidence(cones, asked, made.resolution, 4.0)
    expected = made._answers().rule.probability(*evidence, made.resolution, 3)
    torch.testing.assert_close(theta, expected, rtol=1e-9, atol=1e-9)
    assert (theta[-2:] == 0.5).all()
    assert (theta[:-2] != 0.5).any()
    for scan in open_drive(3, 3):  # and the map goes on
        made.insert(scan)
    assert torch.isfinite(made.occupancy(asked)).all()


def test_a_robot_that_jumps_a_million_metres_is_answered_at_both_places(monkeypatch):
    monkeypatch.setattr(map_query, "_BLOCK", 20)
    near = open_drive(6, 2)
    shift = torch.tensor([1e6, -1e6]).double()
    far = [scan.transformed(shifted(2, (1e6, -1e6))) for scan in near]
    rule = replace(FINE, window=3)
    made = built([*near[:3], *far, *near[3:]], rule, codec="quantized")
    alone = built(near, rule, codec="quantized")
    asked = torch.cat([scan.points[::5] for scan in near]) + 0.01
    for place in (asked, asked + shift):
        theta = made.occupancy(place)
        assert torch.isfinite(theta).all()
        assert float((theta > 0.5).double().mean()) == pytest.approx(
            float((alone.occupancy(asked) > 0.5).double().mean()), abs=0.05
        )
    assert (made.occupancy(asked + 0.5 * shift) == 0.5).all()


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("rule", [FINE, IncrementalRule(), WindowedRule()])
def test_one_window_of_two_places_a_million_metres_apart_is_learned_at_both(rule, dim):
    first, second = open_drive(6, dim)[::2], open_drive(6, dim)[1::2]
    shift = [1e6, -1e7, 3e5][:dim]
    far = [scan.transformed(shifted(dim, shift)) for scan in second]
    rule = replace(rule, window=6)
    made = built([scan for pair in zip(first, far, strict=True) for scan in pair], rule)
    assert made.n_pending == 0
    for scans, place in ((first, [0.0] * dim), (second, shift)):
        asked = torch.cat([scan.points[::5] for scan in scans]) + 0.01
        alone = built(scans, rule).occupancy(asked)
        theta = made.occupancy(asked + asked.new_tensor(place))
        torch.testing.assert_close(theta, alone, rtol=0, atol=0.1)
        assert float((theta > 0.5).double().mean()) == pytest.approx(
            float((alone > 0.5).double().mean()), abs=0.02
        )


def test_places_outside_all_tiles_are_unknown_and_open_none(tmp_path, monkeypatch):
    monkeypatch.setattr(tiled_map, "_RECENT", 10)
    scans = street(12, 2)
    made = TiledMap.create(tmp_path, GaussianMap(replace(FINE, window=3)), 2)
    for scan in scans:
        made.insert(scan)
    opened = TiledMap(tmp_path)
    outside = torch.tensor([[1e6, 0.0], [-1e5, 3.0], [torch.inf, 0.0], [0.0, 1e12]]).double()
    assert (opened.occupancy(outside) == 0.5).all()
    assert opened.n_read == 0
    assert (opened.occupancy(torch.cat([around(scans), outside]))[-4:] == 0.5).all()
