"""absorb: support, budgets, origins and occupancy of incremental learning."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from mapping.map_cases import FINE, absorbed, assert_same_components, built, drive, names, open_drive
from mapping.random_components import counts_add_up, estimated_bytes
from occupancy.protocol_contract import WALL, dims, empty_scan, lattice, open_scan, points, shifted, wall_scan
from torch import Tensor

import gmmtorch
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.experiments.evaluation import metrics, queries
from gmmtorch.mapping import METHODS, Components, GaussianMap, IncrementalRule, NoveltyRule, WindowedRule
from gmmtorch.mapping.learning.fitting import DepthFrame
from gmmtorch.mapping.learning.merging import UNNUMBERED
from gmmtorch.mapping.learning.novelty import entropy_reduction
from gmmtorch.mapping.learning.windows import absorb
from gmmtorch.occupancy import occupancy_probability, point_evidence
from gmmtorch.pinhole import back_project
from gmmtorch.scan import Scan

RULE = IncrementalRule(noise=0.01, length=0.5, cell=0.05, window=2, window_components=30)
INTRINSICS = torch.tensor([[60.0, 0.0, 31.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]], dtype=torch.float64)


def wall_drive(n: int, dim: int) -> list[Scan]:
    """The wall from n positions along it, with some no-return beams."""
    places = [(0.3125, -1.0 + 0.25 * i, 0.0625 * i) for i in range(n)]
    scans = [wall_scan(dim, i, place) for i, place in enumerate(places)]
    return [replace(scan, no_return=open_scan(dim).no_return[::20]) for scan in scans]


def grown(scans: list[Scan], rule: IncrementalRule = RULE) -> Components:
    return absorbed(Components.empty(scans[0].dim), scans, rule).checked()


def occupancy(components: Components, x: Tensor, resolution: float = 0.125) -> Tensor:
    return occupancy_probability(*point_evidence(components.cones(), x, resolution))


@given(
    n=st.integers(1, 5),
    dim=st.sampled_from([2, 3]),
    limit=st.sampled_from([None, 2, 9]),
    window=st.integers(1, 3),
)
@settings(max_examples=15)
def test_support_equals_the_number_of_points_within_the_budget(n, dim, limit, window):
    scans = wall_drive(n, dim)
    found = grown(scans, replace(RULE, n_components=limit, window=window, max_origins=2, mean_origins=None))
    assert counts_add_up(found)
    total = {flag: float(found.support[found.max_range == flag].sum()) for flag in (False, True)}
    assert total[False] == pytest.approx(sum(len(scan.points) for scan in scans), rel=1e-9)
    assert total[True] == pytest.approx(sum(len(scan.no_return) for scan in scans), rel=1e-9)
    assert int(torch.bincount(found.seen_by).max()) <= 2
    if limit is not None:
        assert len(found) <= limit
    places = {tuple(scan.origin.tolist()) for scan in scans}
    assert {tuple(row) for row in found.origins.tolist()} <= places


def test_old_components_keep_their_ids_and_new_ones_have_none():
    scans = wall_drive(4, 3)
    first = grown(scans[:2])
    assert bool((first.ids[:, 1] == UNNUMBERED).all())
    numbered = replace(first, ids=torch.stack([torch.zeros(len(first)), torch.arange(len(first))], 1).long())
    there = Scan(scans[2].points + 50, scans[2].origin + 50)
    second = absorbed(numbered, [there], replace(RULE, max_cost=0.0))
    assert torch.equal(second.ids[: len(first)], numbered.ids)
    assert bool((second.ids[len(first) :, 1] == UNNUMBERED).all())
    assert torch.equal(second.means[: len(first)], first.means)


# -- novelty --------------------------------------------------------------------------------------

NOVEL = replace(RULE, novelty=NoveltyRule(resolution=0.125, threshold=0.5, distance=0.3), window=1)


@dims
def test_repeated_scans_add_few_components(dim):
    once = grown([wall_scan(dim, seed) for seed in range(2)], NOVEL)
    again = absorbed(once, [wall_scan(dim, seed) for seed in range(2, 6)], NOVEL)
    without = grown([wall_scan(dim, seed) for seed in range(6)], replace(RULE, window=1))
    assert len(again) - len(once) < 0.5 * (len(without) - len(once))
    assert float(again.support.sum()) < float(without.support.sum())


@dims
def test_scans_of_new_space_add_components(dim):
    once = grown([wall_scan(dim)], NOVEL)
    beyond = wall_scan(dim, 1)
    beyond = Scan(beyond.points + 8.0, beyond.origin + 8.0)
    both = absorbed(once, [beyond], NOVEL)
    assert float(both.support.sum() - once.support.sum()) == pytest.approx(len(beyond.points))
    x = points([2.0, WALL], dim)
    torch.testing.assert_close(occupancy(both, x + 8.0), occupancy(once, x), rtol=0, atol=0.1)


def test_explained_novel_points_are_counted_instead_of_learned():
    # With a threshold of zero bits every beam is novel; explained points are still counted.
    rule = replace(NOVEL, novelty=NoveltyRule(resolution=0.125, threshold=0.0, distance=0.3, explained=1e9))
    once = grown([wall_scan(3)], rule)
    scan = wall_scan(3, 1)
    twice = absorbed(once, [scan], rule)
    assert len(twice) == len(once)
    assert torch.equal(twice.means, once.means)
    gained = float(twice.support.sum() - once.support.sum())
    assert 0.5 * len(scan.points) < gained <= len(scan.points) + 1e-6


@dims
def test_only_beams_that_contribute_free_space_ask_where_components_were_seen_from(dim):
    once = grown([wall_scan(dim, seed) for seed in range(3)], NOVEL)
    away = wall_scan(dim, 9, (0.3125, 1.0, 0.0))  # further than `distance` from the first place
    known = replace(NOVEL.novelty, observed=0.0, explained=1e9)
    bits, _ = entropy_reduction(once, away, known)
    way, _ = entropy_reduction(once, Scan(away.points[:0], away.origin, away.points), known)
    rule = replace(known, threshold=float(bits.median()))
    by_their_end = int(((bits >= rule.threshold) & (way < rule.threshold)).sum())
    gained = {
        asked: absorbed(once, [away], replace(NOVEL, novelty=replace(rule, distance_for=asked)))
        .support[: len(once)]
        .sum()
        - once.support.sum()
        for asked in ("all", "free_space")
    }
    assert 0 < by_their_end < int((bits >= rule.threshold).sum())
    assert float(gained["all"]) == 0
    assert float(gained["free_space"]) == pytest.approx(by_their_end)


# -- depth images ---------------------------------------------------------------------------------


def absorb_depth(components, frames, intrinsics, rule, pixel_stride=4, max_range=torch.inf):
    scans = (DepthFrame.of(*frame, intrinsics, pixel_stride, max_range) for frame in frames)
    return absorb(components, scans, rule, estimated_bytes, float(pixel_stride**2))[0]


def depth_frames(n: int = 3) -> list[tuple[Tensor, Tensor]]:
    """A slanted wall, a hole in the image, and a camera that moves aside."""
    v, u = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    frames = []
    for i in range(n):
        depth = 2 + 0.01 * u + 0.002 * torch.sin(37 * u + 11 * v + i)
        depth[:8, :8] = float("nan")
        depth[-4:] = 0.0
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 0.2 * i
        frames.append((depth.float(), pose))
    return frames


@pytest.mark.parametrize("stride", [1, 3])
def test_depth_images_give_the_same_evidence_as_their_points(stride):
    frames = depth_frames()
    found = absorb_depth(Components.empty(3), frames, INTRINSICS, RULE, pixel_stride=stride)
    scans = []
    for depth, pose in frames:
        at = back_project(torch.nan_to_num(depth.double()), INTRINSICS, stride)
        scans.append(Scan(at + pose[:3, 3], pose[:3, 3]))
    expected = grown(scans)
    assert float(found.support.sum()) == pytest.approx(stride**2 * sum(len(s.points) for s in scans))
    middles = [(part.support @ part.means) / part.support.sum() for part in (found, expected)]
    torch.testing.assert_close(*middles, rtol=0, atol=1e-6)
    # The cells of images and of points begin at different places, so components differ a little.
    scaled = replace(expected, seen_count=expected.seen_count * stride**2)
    asked = torch.cat([s.points + step * (s.origin - s.points) for s in scans for step in (0.0, 0.1)])
    answers = [occupancy(part, asked) for part in (found, scaled)]
    assert float((answers[0] - answers[1]).abs().mean()) < 0.03


def test_pixels_beyond_the_range_and_empty_images_add_nothing():
    near = absorb_depth(Components.empty(3), depth_frames(1), INTRINSICS, RULE, 1, max_range=2.3)
    scan_points = back_project(torch.nan_to_num(depth_frames(1)[0][0]).double(), INTRINSICS)
    assert float(near.support.sum()) == pytest.approx(int((scan_points[:, 2] < 2.3).sum()))
    blank = [(torch.zeros(48, 64), torch.eye(4, dtype=torch.float64))]
    assert len(absorb_depth(Components.empty(3), blank, INTRINSICS, RULE)) == 0


def test_a_map_learns_depth_images_like_its_rule():
    made, frames = GaussianMap(RULE, codec="float"), depth_frames()
    made.insert_depth(frames, INTRINSICS, pixel_stride=2)
    expected = absorb_depth(Components.empty(3), frames, INTRINSICS, RULE, pixel_stride=2)
    found = made.components()
    assert sorted(found.support.tolist()) == sorted(expected.support.tolist())
    assert sorted(found.ids[:, 1].tolist()) == list(range(len(found)))
    small = GaussianMap(replace(RULE, max_bytes=900))
    small.insert(wall_scan(3))
    small.insert_depth(frames, INTRINSICS)
    assert small.nbytes <= 900 < made.nbytes
    small.insert_depth([], INTRINSICS)
    with pytest.raises(InvalidArgumentError, match="IncrementalRule"):
        GaussianMap(WindowedRule()).insert_depth(frames, INTRINSICS)
    flat = GaussianMap()
    flat.insert(wall_scan(2))
    with pytest.raises(InvalidArgumentError, match="2-dimensional"):
        flat.insert_depth(frames, INTRINSICS)


@pytest.mark.slow
@pytest.mark.real_data
def test_a_map_of_the_hall_fits_in_eight_kilobytes(real_data: Path):
    scans = list(gmmtorch.datasets.load("scan_folder", path=real_data / "hall"))
    train, test = queries.split_indices(len(scans), 5)
    rule = IncrementalRule(
        noise=0.02, length=1.0, cell=0.15, window=12, window_components=500, max_bytes=8000
    )
    found = grown([scans[i] for i in train], rule)
    origins, ends = queries.test_beams([scans[i] for i in test], 2000, 0)
    asked = queries.hit_and_free(origins, ends, "uniform", 0.2, 0)
    theta = occupancy(found, asked.points, 0.2)
    assert estimated_bytes(found) <= 8000
    assert metrics.roc(theta[asked.of(queries.OCCUPIED)], theta[asked.of(queries.FREE)]).auc > 0.985


def test_insert_depth_takes_arrays_and_asks_for_the_unit_of_whole_numbers():
    metres, pose = depth_frames(1)[0]
    millimetres = (torch.nan_to_num(metres) * 1000).round().numpy().astype(np.uint16)
    made, expected = GaussianMap(RULE), GaussianMap(RULE)
    made.insert_depth([(millimetres, pose.numpy())], INTRINSICS.numpy(), depth_scale=0.001)
    expected.insert_depth([(torch.from_numpy(millimetres / 1000.0), pose)], INTRINSICS)
    torch.testing.assert_close(made.means, expected.means, rtol=0, atol=1e-6)
    with pytest.raises(InvalidArgumentError, match=r"^depth is an image of whole numbers.*depth_scale"):
        GaussianMap(RULE).insert_depth([(millimetres, pose)], INTRINSICS)
    with pytest.raises(InvalidArgumentError, match=r"^intrinsics=.*looks transposed"):
        made.insert_depth([(metres, pose)], INTRINSICS.T)
    with pytest.raises(InvalidArgumentError, match=r"^frames\[0\] is a Tensor; give pairs"):
        made.insert_depth([metres], INTRINSICS)


def test_broken_frames_are_named_and_the_others_learned():
    whole = depth_frames(5)
    (depth, pose), lost = whole[0], torch.full((48, 64), torch.nan)
    sheared = pose.clone()
    sheared[0, 1] = 0.5
    broken = {0: (depth[0], pose), 2: (depth, sheared), 5: depth, 7: (depth, pose[:3])}
    frames = list(whole)
    for index, bad in broken.items():
        frames.insert(index, bad)
    made, expected = GaussianMap(RULE), GaussianMap(RULE)
    expected.insert_depth(whole, INTRINSICS)
    with pytest.raises(InvalidArgumentError) as error:
        made.insert_depth([*frames, (lost, pose)], INTRINSICS)  # a frame without a valid pixel is no error
    text = str(error.value)
    assert text.startswith("frames[0], frames[2], frames[5], frames[7] are not learned; the other 6 frames")
    assert text.endswith("depth has shape (64,); expected one image (H, W) of at least one pixel.")
    for name in ("means", "covariances", "support", "ids", "origins", "seen_by", "seen_from", "seen_count"):
        assert torch.equal(getattr(made, name), getattr(expected, name)), name
    with pytest.raises(InvalidArgumentError, match=r"^frames\[1\] is not learned.*pose=.* is not rigid"):
        made.insert_depth([whole[0], (depth, sheared)], INTRINSICS)


def test_a_frame_beyond_a_map_is_named_and_the_map_stays():
    made, frames = GaussianMap(RULE), depth_frames(3)
    made.insert_depth(frames, INTRINSICS)
    before = made.components().means.clone()
    away = frames[1][0].double()
    away[20, 20] = 1e9
    with pytest.raises(InvalidArgumentError, match=r"^frames\[1\] has such points: .*134217728"):
        made.insert_depth([frames[0], (away, frames[1][1]), frames[2]], INTRINSICS)
    assert torch.equal(made.components().means, before)


def test_batches_of_whole_windows_give_the_map_of_all_frames():
    frames = depth_frames(12)
    rule = replace(RULE, window=4)
    at_once, in_parts = GaussianMap(rule, codec="float"), GaussianMap(rule, codec="float")
    at_once.insert_depth(frames, INTRINSICS)
    for begin in range(0, 12, 4):
        in_parts.insert_depth(frames[begin : begin + 4], INTRINSICS)
    # Their numbers, which follow the order of space, are given batch by batch.
    by_place = [made.unrounded().means[:, 0].argsort() for made in (at_once, in_parts)]
    for name in ("means", "covariances", "support"):
        values = [
            getattr(made.unrounded(), name)[order]
            for made, order in zip((at_once, in_parts), by_place, strict=True)
        ]
        assert torch.equal(*values), name


# -- the map ------------------------------------------------------------------------------------------


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
    ("dim", "codec", "rule"),
    [
        (2, "quantized", replace(FINE, max_bytes=650, window=5)),
        (3, "quantized", replace(FINE, max_bytes=650, window=1)),
        (2, "float", replace(FINE, max_bytes=5000, window=2)),
        (3, "float", replace(FINE, max_bytes=5000, window=5)),
        # Headers are padded to eight bytes, so that one more digit may or may not change the size.
        *((2, "quantized", replace(FINE, max_bytes=limit, window=3)) for limit in (600, 632, 664)),
        # Fitted to the scans.
        *((dim, "quantized", IncrementalRule(max_bytes=n, window=2)) for dim, n in ((2, 600), (3, 624))),
    ],
)
def test_the_byte_budget_holds_after_every_scan_and_for_the_file(dim, codec, rule, tmp_path):
    made = built([], rule, codec=codec)
    for scan in open_drive(5, dim):
        made.insert(scan)
        assert made.nbytes <= rule.max_bytes
        assert len(written(made, tmp_path)) == made.nbytes
    if rule.noise is not None:  # of the finest pieces, which do not fit without a budget
        assert built(open_drive(5, dim), FINE, codec=codec).nbytes > rule.max_bytes
        assert made.nbytes > 0.8 * rule.max_bytes
    assert made.learning.noise is not None  # fitted, for good
    assert reloaded(made, tmp_path).learning == made.learning


@pytest.mark.parametrize(("dim", "limit"), [(2, 1), (2, 20), (3, 7)])
def test_the_component_budget_holds_after_every_scan(dim, limit):
    made = built([], replace(FINE, n_components=limit))
    for scan in open_drive(5, dim):
        made.insert(scan)
        assert made.n_components <= limit
    assert made.n_components == limit
    assert built(open_drive(5, dim), FINE).n_components > 20


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
