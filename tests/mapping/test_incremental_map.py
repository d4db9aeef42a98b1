"""Maps that merge as they grow, through GaussianMap: budgets, ids, files, and that asking changes nothing.

What is learned and merged is tested in test_incremental and test_compaction.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mapping.map_cases import FINE, assert_same_components, built, drive, names, open_drive
from occupancy.protocol_contract import dims, empty_scan, lattice, open_scan, shifted, wall_scan

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule
from gmmtorch.mapping.query_options import METHODS
from gmmtorch.scan import Scan

TIGHT = replace(FINE, n_components=9)
codecs = pytest.mark.parametrize("codec", ["quantized", "float"])


def written(made: GaussianMap, folder: Path) -> bytes:
    path = folder / "written.safetensors"
    made.save(path)
    return path.read_bytes()


def reloaded(made: GaussianMap, folder: Path) -> GaussianMap:
    made.save(folder / "kept.safetensors")
    return GaussianMap.load(folder / "kept.safetensors")


def test_maps_are_incremental_unless_told_otherwise():
    assert GaussianMap().learning == IncrementalRule()
    assert GaussianMap().codec == "quantized"


# -- budgets ---------------------------------------------------------------------------------------------


@dims
@codecs
@pytest.mark.parametrize("window", [1, 2, 5])
def test_the_budget_in_bytes_holds_after_every_scan_and_for_the_file(dim, codec, window, tmp_path):
    limit = 650 if codec == "quantized" else 5000
    made = built([], replace(FINE, max_bytes=limit, window=window), codec=codec)
    for scan in open_drive(6, dim):
        made.insert(scan)
        assert made.nbytes <= limit
        assert len(written(made, tmp_path)) == made.nbytes
    free = built(open_drive(6, dim), replace(FINE, window=window), codec=codec)
    assert free.nbytes > limit
    assert made.nbytes > 0.8 * limit  # it is used, too


@pytest.mark.parametrize("limit", range(560, 680, 8))
def test_the_budget_holds_to_the_byte_as_numbers_grow_longer(limit):
    # A header is filled up to eight bytes, so a digit more in it may or may not show.
    made = built([], replace(FINE, max_bytes=limit, window=3), codec="quantized")
    for scan in open_drive(5):
        made.insert(scan)
        assert made.nbytes <= limit


@dims
@pytest.mark.parametrize("limit", [1, 2, 7, 20])
def test_the_budget_of_components_holds_after_every_scan(dim, limit):
    made = built([], replace(FINE, n_components=limit))
    for scan in open_drive(5, dim):
        made.insert(scan)
        assert made.n_components <= limit
    assert made.n_components == limit
    assert built(open_drive(5, dim), FINE).n_components > 20


@dims
@pytest.mark.parametrize("limit", range(576, 640, 8))
def test_the_budget_holds_when_the_rule_is_fitted_to_the_scans(dim, limit, tmp_path):
    made = built([], IncrementalRule(max_bytes=limit, window=2), codec="quantized")
    for scan in open_drive(4, dim):
        made.insert(scan)
        assert made.nbytes <= limit
    made.save(tmp_path / "m.safetensors")
    loaded = GaussianMap.load(tmp_path / "m.safetensors").learning
    assert loaded == made.learning
    assert isinstance(loaded, IncrementalRule)
    assert loaded.noise is not None  # fitted, for good


def test_both_budgets_hold():
    for limit, size in ((30, 600), (5, 2000)):
        made = built([], replace(FINE, n_components=limit, max_bytes=size), codec="quantized")
        for scan in open_drive(4):
            made.insert(scan)
            assert made.n_components <= limit
            assert made.nbytes <= size


@pytest.mark.parametrize("window", [1, 3])
def test_a_budget_that_not_even_one_component_fits_is_named(window):
    made = built([], replace(FINE, max_bytes=100, window=window), codec="quantized")
    for scan in drive(window - 1):
        made.insert(scan)
    for _ in range(2):
        with pytest.raises(InvalidArgumentError, match="max_bytes=100"):
            made.insert(drive(3)[2])


# -- ids -------------------------------------------------------------------------------------------------


@dims
@codecs
@pytest.mark.parametrize("learning", [FINE, TIGHT, replace(FINE, max_cost=0.05)])
def test_a_number_is_given_once_through_merging_saving_and_loading(dim, codec, learning, tmp_path):
    made = built([], learning, codec=codec)
    given: set[tuple[int, ...]] = set()
    for i, scan in enumerate(open_drive(9, dim)):
        before = names(made.ids) if made.dim else set()
        made.insert(scan)
        fresh = names(made.ids) - before
        assert not fresh & given
        given |= fresh
        if i == 4:  # in the middle of a window: what is written has numbers of its own
            made = reloaded(made, tmp_path)
            given |= names(made.ids)
    assert (len(given) > 1.2 * made.n_components) is (learning is not FINE)


@dims
def test_whoever_keeps_its_number_is_as_it_was(dim):
    made = built(drive(2, dim), FINE)
    rule = replace(FINE, n_components=made.n_components + 2)
    grown = built(drive(2, dim), rule)
    before = grown.components()
    for scan in drive(4, dim)[2:]:
        grown.insert(scan)
    after = grown.components()
    kept = names(before.ids) & names(after.ids)
    assert 0 < len(kept) < len(before)  # some were merged
    assert min(names(after.ids) - kept) > max(names(before.ids))
    one, other = (
        [components.ids.tolist().index(list(name)) for name in sorted(kept)] for components in (before, after)
    )
    for name in ("means", "covariances", "support", "max_range"):
        assert torch.equal(getattr(before, name)[one], getattr(after, name)[other])


# -- what must not matter --------------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("learning", [FINE, TIGHT, replace(FINE, max_bytes=700)])
def test_the_same_scans_give_the_same_file_whatever_was_asked(dim, learning, tmp_path):
    asked = built([], learning, codec="quantized")
    for scan in open_drive(3, dim):
        asked.insert(scan)
        for method in METHODS if dim == 2 else ("point",):
            asked.occupancy(lattice(dim)[::7], method=method)
        assert asked.nbytes > 0
        assert asked.n_components > 0
        asked.finish()
        assert written(asked, tmp_path) == written(asked, tmp_path)
    left = built(open_drive(3, dim), learning, codec="quantized")
    assert written(asked, tmp_path) == written(left, tmp_path)
    assert torch.equal(asked.means, left.means)


@dims
@pytest.mark.parametrize("learning", [FINE, TIGHT])
def test_empty_scans_fill_windows_and_add_nothing(dim, learning):
    first, second = drive(2, dim)
    made = built([empty_scan(dim), empty_scan(dim)], learning)
    assert (made.n_components, made.dim) == (0, dim)
    assert made.occupancy(lattice(dim)).unique().tolist() == [0.5]
    for scan in (first, empty_scan(dim), empty_scan(dim), second, empty_scan(dim), empty_scan(dim)):
        made.insert(scan)
    assert_same_components(made.components(), built([first, second], learning, window=1).components())


@dims
def test_beams_without_return_alone_are_free_space_only(dim):
    made = built([open_scan(dim)] * 3, TIGHT, cutoff=5.0)
    assert bool(made.components().max_range.all())
    assert made.n_components == 9
    theta = made.occupancy(lattice(dim))
    assert float(theta.max()) == 0.5
    assert float(theta.min()) < 0.3


@dims
def test_far_from_the_origin_the_map_is_the_same(dim):
    matrix = shifted(dim, (524_288.0, -262_144.0, 1024.0))
    near, far = (
        built([scan.transformed(matrix) if move else scan for scan in open_drive(5, dim)], TIGHT)
        for move in (False, True)
    )
    shift = matrix[:dim, dim]
    torch.testing.assert_close(far.means - shift, near.means, rtol=0, atol=1e-6)
    expected = near.occupancy(lattice(dim))
    torch.testing.assert_close(far.occupancy(lattice(dim) + shift), expected, rtol=0, atol=1e-4)


# -- files -----------------------------------------------------------------------------------------------


@dims
@pytest.mark.parametrize("learning", [FINE, TIGHT])
def test_an_exact_map_goes_on_as_if_it_had_not_been_saved(dim, learning, tmp_path):
    scans = open_drive(6, dim)
    loaded = reloaded(built(scans[:4], learning), tmp_path)
    for scan in scans[4:]:
        loaded.insert(scan)
    assert_same_components(loaded.components(), built(scans, learning).components())


@dims
def test_a_rounded_map_goes_on_within_its_budget(dim, tmp_path):
    learning = replace(FINE, max_bytes=700)
    made = built(open_drive(3, dim), learning, codec="quantized")
    loaded = reloaded(made, tmp_path)  # in the middle of a window
    assert loaded.learning == learning
    assert loaded.nbytes == made.nbytes
    elsewhere = shifted(dim, (20.0, 0.0, 0.0))
    for scan in drive(3, dim):
        loaded.insert(scan.transformed(elsewhere))
        assert loaded.nbytes <= 700
    wall = wall_scan(dim).points[::40]
    for where in (wall, wall + elsewhere[:dim, dim]):
        assert float(loaded.occupancy(where).mean()) > 0.5


def test_the_rule_of_novelty_comes_back_and_is_followed(tmp_path):
    learning = replace(FINE, novelty=NoveltyRule(resolution=0.125, distance=0.4), n_components=30)
    made = built(drive(2), learning)
    loaded = reloaded(made, tmp_path)
    assert loaded.learning == learning
    for both in (made, loaded):
        both.insert(Scan(wall_scan(2).points + 9.0, wall_scan(2).origin + 9.0))
    assert_same_components(loaded.components(), made.components())
