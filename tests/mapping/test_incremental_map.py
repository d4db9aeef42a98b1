"""Incremental GaussianMap: budgets, ids, files, and independence of queries."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from mapping.map_cases import FINE, assert_same_components, built, drive, names, open_drive
from occupancy.protocol_contract import dims, empty_scan, lattice, shifted, wall_scan

from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, NoveltyRule
from gmmtorch.mapping.query_options import METHODS
from gmmtorch.scan import Scan

TIGHT = replace(FINE, n_components=9)


def written(made: GaussianMap, folder: Path) -> bytes:
    path = folder / "written.safetensors"
    made.save(path)
    return path.read_bytes()


def reloaded(made: GaussianMap, folder: Path) -> GaussianMap:
    made.save(folder / "kept.safetensors")
    return GaussianMap.load(folder / "kept.safetensors")


def test_the_default_map_is_incremental_and_quantized():
    assert GaussianMap().learning == IncrementalRule()
    assert GaussianMap().codec == "quantized"


# -- budgets ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dim", "codec", "window", "limit"),
    [
        (2, "quantized", 5, 650),
        (3, "quantized", 1, 650),
        (2, "float", 2, 5000),
        (3, "float", 5, 5000),
        # Headers are padded to eight bytes, so that one more digit may or may not change the size.
        *((2, "quantized", 3, limit) for limit in (600, 632, 664)),
    ],
)
def test_the_byte_budget_holds_after_every_scan_and_for_the_file(dim, codec, window, limit, tmp_path):
    made = built([], replace(FINE, max_bytes=limit, window=window), codec=codec)
    for scan in open_drive(5, dim):
        made.insert(scan)
        assert made.nbytes <= limit
        assert len(written(made, tmp_path)) == made.nbytes
    assert built(open_drive(5, dim), FINE, codec=codec).nbytes > limit
    assert made.nbytes > 0.8 * limit


@pytest.mark.parametrize(("dim", "limit"), [(2, 1), (2, 20), (3, 7)])
def test_the_component_budget_holds_after_every_scan(dim, limit):
    made = built([], replace(FINE, n_components=limit))
    for scan in open_drive(5, dim):
        made.insert(scan)
        assert made.n_components <= limit
    assert made.n_components == limit
    assert built(open_drive(5, dim), FINE).n_components > 20


@pytest.mark.parametrize(("dim", "limit"), [(2, 600), (2, 640), (3, 624)])
def test_the_byte_budget_holds_for_a_rule_fitted_to_the_scans(dim, limit, tmp_path):
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
    for limit, size in ((30, 640), (5, 2000)):  # the budget in bytes binds, then that in components
        made = built([], replace(FINE, n_components=limit, max_bytes=size), codec="quantized")
        for scan in open_drive(4):
            made.insert(scan)
            assert made.n_components <= limit
            assert made.nbytes <= size


@pytest.mark.parametrize("window", [1, 3])
def test_a_budget_below_one_component_is_refused(window):
    made = built([], replace(FINE, max_bytes=100, window=window), codec="quantized")
    for scan in drive(window - 1):
        made.insert(scan)
    for _ in range(2):
        with pytest.raises(InvalidArgumentError, match="max_bytes=100"):
            made.insert(drive(3)[2])
        if window > 1:  # a query learns the pending scans each time, and does not leave them out
            with pytest.raises(InvalidArgumentError, match="max_bytes=100"):
                made.components()


# -- ids -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("dim", "codec", "learning"),
    [
        (2, "quantized", FINE),
        (3, "float", TIGHT),
        (3, "quantized", TIGHT),
        (2, "float", replace(FINE, max_cost=0.05)),
    ],
)
def test_an_id_is_never_reused_by_merging_saving_or_loading(dim, codec, learning, tmp_path):
    made = built([], learning, codec=codec)
    given: set[tuple[int, ...]] = set()
    for i, scan in enumerate(open_drive(9, dim)):
        before = names(made.state_dict()["ids"]) if made.dim else set()
        made.insert(scan)
        fresh = names(made.state_dict()["ids"]) - before  # the unfinished window has no final numbers
        assert not fresh & given
        given |= fresh
        if i == 4:  # in the middle of a window: the file numbers the pending components
            made = reloaded(made, tmp_path)
            given |= names(made.ids)
    assert (len(given) > 1.2 * made.n_components) is (learning is not FINE)


@dims
def test_components_with_an_unchanged_id_are_unchanged(dim):
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


# -- independence ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dim", "learning"), [(2, FINE), (2, replace(FINE, max_bytes=700)), (3, TIGHT)])
def test_equal_scans_give_equal_files_whatever_was_queried(dim, learning, tmp_path):
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


@pytest.mark.parametrize(("dim", "learning"), [(2, FINE), (3, TIGHT)])
def test_empty_scans_fill_windows_and_add_no_components(dim, learning):
    first, second = drive(2, dim)
    made = built([empty_scan(dim), empty_scan(dim)], learning)
    assert (made.n_components, made.dim) == (0, dim)
    assert made.occupancy(lattice(dim)).unique().tolist() == [0.5]
    for scan in (first, empty_scan(dim), empty_scan(dim), second, empty_scan(dim), empty_scan(dim)):
        made.insert(scan)
    assert_same_components(made.components(), built([first, second], learning, window=1).components())


# -- files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dim", "learning"), [(2, FINE), (3, TIGHT)])
def test_a_loaded_float_map_continues_bit_by_bit(dim, learning, tmp_path):
    scans = open_drive(6, dim)
    loaded = reloaded(built(scans[:4], learning), tmp_path)
    for scan in scans[4:]:
        loaded.insert(scan)
    assert_same_components(loaded.components(), built(scans, learning).components())


@dims
def test_a_loaded_quantized_map_continues_within_its_budget(dim, tmp_path):
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


def test_a_loaded_map_follows_its_novelty_rule(tmp_path):
    learning = replace(FINE, novelty=NoveltyRule(resolution=0.125, distance=0.4), n_components=30)
    made = built(drive(2), learning)
    loaded = reloaded(made, tmp_path)
    assert loaded.learning == learning
    for both in (made, loaded):
        both.insert(Scan(wall_scan(2).points + 9.0, wall_scan(2).origin + 9.0))
    assert_same_components(loaded.components(), made.components())
