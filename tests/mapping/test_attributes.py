"""Attributes of components: learning, merging, prediction, motion, and their block in map files."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from kernels.twins import by_both
from mapping.map_cases import FINE, assert_same_components, drive, merged, some_motion
from scipy.stats import multivariate_normal
from torch import Tensor

import gmmtorch as gt
from gmmtorch import Components, Scan
from gmmtorch.errors import DataError, InvalidArgumentError
from gmmtorch.files import read_tensors
from gmmtorch.mapping import Attributes, BitWriter, Labels, Numbers, TiledMap, quantized, tile_files
from gmmtorch.mapping.attributes import moments
from gmmtorch.mapping.attributes.answers import predictions
from gmmtorch.mapping.codec import number_model
from gmmtorch.mapping.codec.attribute_block import (
    BLOCK_VERSION,
    _factors,
    decode_attributes,
    encode_attributes,
)
from gmmtorch.mapping.learning.merging import compact
from gmmtorch.mixture import Cells, merge_components
from gmmtorch.mixture.em.exact import quadratic_features
from gmmtorch.scan import display_colours, linear_colours


def seeded(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=seeded(seed), dtype=torch.float64)


def painted(scan: Scan, seed: int = 0) -> Scan:
    """The scan with a colour that follows the place, intensity, and two classes at y = 0."""
    y = scan.points[:, 1].double()
    colour = torch.stack([0.5 + 0.2 * torch.tanh(y), 0.5 - 0.2 * torch.tanh(y), torch.full_like(y, 0.25)], 1)
    colour = (colour + 0.02 * normal(len(y), 3, seed=seed)).clamp(0, 1)
    channels = {"colour": colour, "intensity": 40 + 3 * y, "class": (y > 0).long() * 7}
    return replace(scan, attributes=channels)


def painted_map(n: int = 6, dim: int = 2, **options: Any) -> gt.GaussianMap:
    made = gt.GaussianMap(FINE, **options)
    for seed, scan in enumerate(drive(n, dim)):
        made.insert(painted(scan, seed))
    return made


def coloured_components(dim: int = 3, k: int = 5, width: int = 2) -> Components:
    root, both = 0.3 * normal(k, dim, dim, seed=1), normal(k, width, dim, seed=2)
    noise = 0.2 * normal(k, width, width, seed=3)
    share = torch.linspace(0.2, 1, k, dtype=torch.float64)
    own = Numbers(share, normal(k, width, seed=4), both, noise @ noise.mT + 0.01 * torch.eye(width).double())
    labels = Labels(torch.softmax(normal(k, 3, seed=6), 1) * share[:, None], torch.tensor([2, 5, 9]))
    made = Components.given(
        normal(k, dim, seed=5), root @ root.mT + 0.01 * torch.eye(dim).double(),
        torch.arange(1.0, k + 1), normal(k, dim, seed=7), None, 0,
    )  # fmt: skip
    return replace(made, attributes=Attributes({"heat": own, "class": labels}))


def joint(c: Components, name: str = "heat") -> tuple[Tensor, Tensor]:
    """Means and covariances of (position, attribute)."""
    own = c.attributes.channels[name]
    assert isinstance(own, Numbers)
    both = own.slope @ c.covariances
    bottom = torch.cat([both, own.covariance + both @ own.slope.mT], 2)
    joined = torch.cat([torch.cat([c.covariances, both.mT], 2), bottom], 1)
    return torch.cat([c.means, own.mean], 1), joined


# -- learning --------------------------------------------------------------------------------------------


def cells_of(points: Tensor) -> Cells:
    """Every point in a cell of its own, in a random order."""
    order = torch.randperm(len(points), generator=seeded(3))
    return Cells(quadratic_features(points[order]), torch.ones(len(points)).double(), order.argsort())


def test_a_slope_is_that_of_least_squares_with_points_without_slope():
    points, owner = normal(400, 3), torch.arange(400) % 2
    values = 1000 + points @ normal(3, 2, seed=1) + 0.1 * normal(400, 2, seed=2)
    means = torch.stack([points[owner == i].mean(0) for i in (0, 1)])
    covariances = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    cells = cells_of(points)
    of_cells = owner[cells.member.argsort()]
    found = moments.learned({"heat": values}, cells, of_cells, means, covariances).channels["heat"]
    for i in (0, 1):
        offset, own = (points[owner == i] - means[i]).numpy(), values[owner == i].numpy()
        rows = np.vstack([offset, np.sqrt(3.0) * np.eye(3)])  # three points, spread like the component
        slope, *_ = np.linalg.lstsq(rows, np.vstack([own - own.mean(0), np.zeros((3, 2))]), None)
        np.testing.assert_allclose(found.slope[i].numpy(), slope.T, rtol=1e-8)
        np.testing.assert_allclose(found.mean[i].numpy(), own.mean(0), rtol=1e-9)
        left = own - own.mean(0) - offset @ slope
        np.testing.assert_allclose(found.covariance[i].numpy(), left.T @ left / 200, atol=1e-4)
    assert found.share.tolist() == [1.0, 1.0]


def test_points_without_a_value_and_components_without_points_do_not_count():
    values = torch.tensor([[1.0], [torch.nan], [3.0]], dtype=torch.float64)
    cells = cells_of(torch.zeros(3, 3).double())
    owner = torch.tensor([0, 0, -1])[cells.member.argsort()]
    means, covariances = torch.zeros(2, 3).double(), torch.eye(3).double().repeat(2, 1, 1)
    channels = {"heat": values, "class": torch.tensor([4, -1, 4])}
    found = moments.learned(channels, cells, owner, means, covariances).channels
    assert found["heat"].share.tolist() == [0.5, 0.0]
    assert found["heat"].mean.tolist() == [[1.0], [0.0]]
    assert found["class"].share.tolist() == [[0.5], [0.0]]
    assert found["class"].labels.tolist() == [4]


def test_merges_of_neighbours_with_different_colours_cost_more():
    """Two pairs of equal geometry; the one of one colour is merged."""
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [10, 0, 0], [11, 0, 0]]).double()
    c = Components.given(means, torch.eye(3).double().repeat(4, 1, 1), torch.ones(4), means + 5, None, 0)
    for rows, merged_pair in (([0.2, 0.8, 0.2, 0.2], 10.5), ([0.2, 0.2, 0.2, 0.8], 0.5)):
        mean = torch.tensor(rows).double()[:, None].expand(4, 3)
        noise = 1e-4 * torch.eye(3).double().repeat(4, 1, 1)
        own = Numbers(torch.ones(4).double(), mean, torch.zeros(4, 3, 3).double(), noise)
        found = compact(replace(c, attributes=Attributes({"colour": own})), 3)
        assert merged_pair in found.means[:, 0].tolist()


@pytest.mark.parametrize("dim", [2, 3])
def test_attributes_change_neither_the_geometry_nor_its_bytes(dim, tmp_path):
    plain, coloured = gt.GaussianMap(FINE), painted_map(dim=dim)
    for scan in drive(6, dim):
        plain.insert(scan)
    assert_same_components(plain.components(), coloured.components())
    assert not plain.components().attributes
    assert plain.attributes(torch.zeros(1, dim)) == {}
    plain.save(tmp_path / "plain.safetensors")
    tensors, _ = read_tensors(tmp_path / "plain.safetensors", "gmmtorch.map", 2)
    assert list(tensors) == ["components"]


def test_scans_with_and_without_colour_make_one_map():
    made = gt.GaussianMap(FINE)
    for i, scan in enumerate(drive(6)):
        made.insert(painted(scan) if i % 2 else scan)
    own = made.components().attributes.channels["colour"]
    assert 0 < float(own.share.mean()) < 1
    found = made.attributes(drive(6)[0].points)["colour"]
    assert bool(found.known.all())
    assert bool(torch.isfinite(found.mean).all())


def test_one_channel_cannot_be_numbers_and_labels():
    one, other = drive(2)
    one = replace(one, attributes={"heat": torch.zeros(len(one.points))})
    other = replace(other, attributes={"heat": torch.zeros(len(other.points), dtype=torch.int64)})
    for made in (gt.GaussianMap(FINE), gt.GaussianMap(replace(FINE, window=5))):
        made.insert(one)
        with pytest.raises(
            InvalidArgumentError, match="'heat' are numbers in some scans and labels in others"
        ):
            made.insert(other)
        assert set(made.attributes(one.points)) == {"heat"}  # the map is as it was


# -- merging and moving ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_merging_preserves_the_moments_of_position_and_attribute(dim):
    c = coloured_components(dim)
    own = c.attributes.channels["heat"]
    whole = own._replace(share=torch.ones(5).double())
    c = replace(c, attributes=Attributes({**c.attributes.channels, "heat": whole}))
    labels = torch.tensor([0, 1, 0, 1, 2])
    found = merged(c, labels)
    expected = merge_components(c.support, *joint(c), labels, 3)
    for value, wanted in zip(joint(found), (expected.means, expected.covariances), strict=True):
        torch.testing.assert_close(value, wanted, rtol=1e-9, atol=1e-12)
    counts = c.support[:, None] * c.attributes.channels["class"].share
    summed = torch.zeros(3, 3).double().index_add_(0, labels, counts)
    torch.testing.assert_close(found.support[:, None] * found.attributes.channels["class"].share, summed)
    alone = found.attributes.channels["heat"]
    assert torch.equal(alone.slope[2], own.slope[4])
    assert torch.equal(alone.covariance[2], own.covariance[4])


def test_a_component_without_values_does_not_change_those_of_the_other_in_a_merge():
    c = coloured_components(k=2)
    own = c.attributes.channels["heat"]
    none = own._replace(share=torch.tensor([1.0, 0.0]).double())
    found = merged(replace(c, attributes=Attributes({"heat": none})), torch.tensor([0, 0]))
    made, at = found.attributes.channels["heat"], c.means[0] - found.means[0]
    torch.testing.assert_close(made.slope[0], own.slope[0])
    torch.testing.assert_close(made.mean[0] + made.slope[0] @ at, own.mean[0])
    torch.testing.assert_close(made.share, (c.support[:1] / c.support.sum()))


def test_parts_of_components_have_their_own_attributes():
    c = coloured_components(k=5)
    for part, rows in zip(c.split([2, 5]), (slice(0, 2), slice(2, 5)), strict=True):
        part.checked()
        assert torch.equal(part.attributes.channels["heat"].mean, c.attributes.channels["heat"].mean[rows])


def test_predictions_move_with_the_components():
    made, motion = painted_map(dim=3, codec="float"), some_motion(3)
    points = drive(6, 3)[0].points.double()[:50]
    before = made.attributes(points)
    made.transform(motion)
    after = made.attributes(points @ motion[:3, :3].T + motion[:3, 3])
    for name, found in before.items():
        torch.testing.assert_close(after[name].mean, found.mean, rtol=1e-7, atol=1e-9)
        assert torch.equal(after[name].known, found.known)


# -- prediction ------------------------------------------------------------------------------------------


def test_predictions_are_those_of_the_joint_mixture():
    c = coloured_components()
    c = replace(c, attributes=Attributes({"heat": c.attributes.channels["heat"]}))
    points = c.means + 0.05 * normal(5, 3, seed=9)
    found = predictions(c, points, cutoff=40.0)["heat"]
    means, covariances = joint(c)
    known = (c.support * c.attributes.channels["heat"].share)[:, None]
    usual = (known * means[:, 3:]).sum(0) / known.sum()
    around = covariances[:, 3:, 3:].diagonal(dim1=1, dim2=2) + (means[:, 3:] - usual) ** 2
    gradients = covariances[:, 3:, :3] @ torch.linalg.inv(covariances[:, :3, :3])
    around = around - (gradients @ covariances[:, :3, 3:]).diagonal(dim1=1, dim2=2)
    least = 0.01 * (known * around).sum(0) / known.sum()  # a tenth of the deviation in the map
    for row, point in enumerate(points):
        weight, mean, square = [], [], []
        for k in range(5):
            own = covariances[k]
            gain = own[3:, :3] @ torch.linalg.inv(own[:3, :3])
            offset = point - means[k, :3]
            far = float((offset @ torch.linalg.inv(own[:3, :3]) @ offset).sqrt())
            offset = offset * min(1, 2.5 / far)  # slopes are followed up to 2.5 deviations
            value = means[k, 3:] + gain @ offset
            density = multivariate_normal(means[k, :3].numpy(), own[:3, :3].numpy()).pdf(point.numpy())
            noise = (own[3:, 3:] - gain @ own[:3, 3:]).diagonal()
            weight.append(known[k] * density / (noise + least).sqrt())
            mean.append(value)
            square.append(noise + value**2)
        shares = torch.stack(weight) / torch.stack(weight).sum(0)
        wanted = (shares * torch.stack(mean)).sum(0)
        torch.testing.assert_close(found.mean[row], wanted, rtol=1e-8, atol=1e-10)
        variance = (shares * torch.stack(square)).sum(0) - wanted**2
        torch.testing.assert_close(found.variance[row], variance, rtol=1e-7, atol=1e-9)


def test_predictions_are_differentiable_and_unknown_far_away():
    c = coloured_components()
    points = (c.means + 0.02).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: predictions(c, x)["heat"].mean, points)
    far = torch.tensor([[1e3, 0.0, 0.0], [torch.inf, 0.0, 0.0]]).double()
    found = predictions(c, far)
    assert not bool(found["heat"].known.any())
    assert bool(torch.isfinite(found["heat"].mean).all())
    assert found["class"].most_likely.tolist() == [-1, -1]
    torch.testing.assert_close(found["class"].mean.sum(1), torch.ones(2).double())


def test_a_painted_wall_has_a_gradient_and_two_classes():
    made = painted_map(dim=3)
    scan = painted(drive(6, 3)[0])
    found = made.attributes(scan.points)
    assert bool(found["colour"].known.all())
    off = (found["colour"].mean - scan.attributes["colour"]).square().mean().sqrt()
    assert float(off) < 0.04
    assert float((found["intensity"].mean[:, 0] - scan.attributes["intensity"][:, 0]).abs().mean()) < 1.0
    right = found["class"].most_likely == scan.attributes["class"]
    assert float(right.double().mean()) > 0.95
    with pytest.raises(InvalidArgumentError, match="numbers, not labels"):
        _ = found["colour"].most_likely


# -- files -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("codec", ["quantized", "float"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_saved_map_gives_the_same_attributes(tmp_path, codec, dim):
    made, path = painted_map(dim=dim, codec=codec), tmp_path / "map.safetensors"
    made.save(path)
    loaded = gt.GaussianMap.load(path)
    for name, value in made.components().attributes.tensors().items():
        torch.testing.assert_close(
            loaded.components().attributes.tensors()[name], value, rtol=1e-12, atol=1e-14
        )
    loaded.save(tmp_path / "again.safetensors")
    assert (tmp_path / "again.safetensors").read_bytes() == path.read_bytes()
    for row in map(int, torch.randperm(len(made.components()), generator=seeded(0))[:3]):
        alone = made.components().selected(torch.tensor([row]))  # each component is rounded by itself
        torch.testing.assert_close(
            quantized(alone).attributes.channels["colour"].mean if codec == "quantized" else
            alone.attributes.channels["colour"].mean,
            made.components().attributes.channels["colour"].mean[row, None],
        )  # fmt: skip


def test_rounding_is_bounded_in_deviations():
    c = coloured_components(k=40)
    once = quantized(c)
    own, found = c.attributes.channels["heat"], once.attributes.channels["heat"]
    noise = found.covariance.diagonal(dim1=1, dim2=2).sqrt()
    moved = own.mean + (own.slope @ (once.means - c.means)[:, :, None])[:, :, 0]
    half = noise * 0.25 * (1 + 1e-9)  # of a step, which is σ/2
    assert bool(((moved - found.mean).abs() <= half).all())
    along = (own.slope - found.slope) @ _factors(once.covariances)  # over a deviation of each axis
    assert bool((along.abs() <= half[:, :, None]).all())
    ratio = noise / own.covariance.diagonal(dim1=1, dim2=2).sqrt()
    assert float(ratio.min()) > 2**-0.26
    assert float(ratio.max()) < 2**0.26


@settings(max_examples=40)
@given(st.integers(0, 2**32), st.floats(-12, 12), st.floats(-12, 12))
def test_rounding_again_changes_nothing_at_any_scale(seed, mean, noise):
    c = coloured_components(k=8)
    own = Numbers(
        torch.ones(8).double(),
        10.0**mean * normal(8, 2, seed=seed),
        10.0**noise * normal(8, 2, 3, seed=seed),
        10.0 ** (2 * noise) * torch.diag_embed(normal(8, 2, seed=seed).square()),
    )
    once = quantized(replace(c, attributes=Attributes({**c.attributes.channels, "heat": own})))
    twice = quantized(once).attributes.tensors()
    for name, value in once.attributes.tensors().items():
        torch.testing.assert_close(twice[name], value, rtol=1e-9, atol=1e-300)


def test_colour_takes_four_bytes_and_a_class_one():
    made = painted_map(12, 3)
    c = made.components()
    for name, most in (("colour", 4.0), ("class", 1.0)):
        alone = Attributes({name: c.attributes.channels[name]})
        assert len(encode_attributes(alone, c.covariances)) - 40 <= most * len(c)


@given(st.integers(0, 2**32), st.integers(0, 255))
def test_damaged_blocks_raise_a_data_error(place, value):
    c = quantized(coloured_components())
    data = bytearray(encode_attributes(c.attributes, c.covariances))
    data[place % len(data)] ^= value
    for damaged in (bytes(data), bytes(data[: place % len(data)])):
        try:
            found = decode_attributes(damaged, c.covariances)
        except DataError:
            continue
        found.checked(len(c), 3)


def test_many_components_with_many_labels_are_refused_before_memory_is_taken():
    """The block has a bit for each label, and none for each component, as no component has a label."""
    none, writer = np.zeros(0, np.int64), BitWriter()
    writer.number(1)
    writer.number(1)
    writer.fixed(np.array([ord("c")]), 8)
    writer.number(0)
    writer.number(65536)
    for column in (np.arange(65536), np.zeros(100_000, np.int64), none, none, none):
        writer.column(column)
    eye = torch.eye(3, dtype=torch.float64).expand(100_000, 3, 3)
    with pytest.raises(DataError, match="too many to read"):
        decode_attributes(bytes([BLOCK_VERSION]) + writer.to_bytes(), eye)


def test_a_budget_holds_with_attributes(tmp_path):
    made = gt.GaussianMap(replace(FINE, max_bytes=1500))
    for seed, scan in enumerate(drive(8, 3)):
        made.insert(painted(scan, seed))
    assert made.nbytes <= 1500
    assert set(made.components().attributes.channels) == {"colour", "intensity", "class"}


def test_state_and_tiles_keep_attributes(tmp_path):
    made = painted_map(5, 3)  # one scan is pending
    again = gt.GaussianMap(FINE)
    again.load_state_dict(made.state_dict())
    points = drive(5, 3)[0].points
    wanted = made.attributes(points)["colour"].mean
    torch.testing.assert_close(again.attributes(points)["colour"].mean, wanted)
    for name, data in tile_files(made.components(), made.settings, 0.5).items():
        (tmp_path / name).write_bytes(data)
    whole = TiledMap(tmp_path).open()
    torch.testing.assert_close(whole.attributes(points)["colour"].mean, wanted, rtol=1e-6, atol=1e-9)


# -- scans -----------------------------------------------------------------------------------------------


def scan_of(**channels: Any) -> Scan:
    return Scan(torch.ones(2, 3), torch.zeros(3), attributes=channels)


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("colour", torch.tensor([[0.0, 0.5, 200.0]] * 2), "outside 0 to 1"),
        ("colour", torch.zeros(2, 3, dtype=torch.int64), "as uint8"),
        ("colour", torch.zeros(2), r"expected \(2, 3\)"),
        ("intensity", torch.zeros(3), r"expected \(2,\)"),
        ("intensity", torch.tensor([torch.inf, 0.0]), "beyond 1e"),
        ("intensity", torch.tensor([1e13, 0.0]), "beyond 1e"),
        ("", torch.zeros(2), "1 to 64 bytes"),
        ("é" * 33, torch.zeros(2), "1 to 64 bytes"),
        ("intensity", torch.zeros(2, 9), "9 columns"),
        ("class", torch.tensor([0, 65536]), "from 0 to 65535"),
        ("class", torch.tensor([0, -2]), "from 0 to 65535"),
    ],
)
def test_bad_channels_are_refused_with_the_remedy(name, value, reason):
    with pytest.raises(InvalidArgumentError, match=reason):
        scan_of(**{name: value})


@pytest.mark.parametrize("value", [torch.zeros(2, 3), [torch.zeros(2)]])
def test_channels_without_names_are_refused(value):
    with pytest.raises(InvalidArgumentError, match="name each channel"):
        Scan(torch.zeros(2, 3), torch.ones(3), attributes=value)


def test_a_change_of_attributes_alone_counts():
    made = painted_map(5, 3)
    made.revise(lambda c: c)
    assert set(made.components().attributes.channels) == {"colour", "intensity", "class"}
    kept = {"intensity": made.unrounded().attributes.channels["intensity"]}
    made.revise(lambda c: replace(c, attributes=Attributes(kept)))
    assert set(made.components().attributes.channels) == {"intensity"}
    made.insert(painted(drive(6, 3)[5]))
    again = quantized(made.unrounded())
    for name, value in made.components().attributes.tensors().items():
        assert torch.equal(value, again.attributes.tensors()[name]), name


def test_no_points_have_no_attributes():
    assert painted_map(2, 3).attributes(torch.zeros(0, 3))["colour"].mean.shape == (0, 3)


@pytest.mark.parametrize(
    ("part", "change"),
    [
        ("mean", lambda value: value.sum()),
        ("mean", lambda value: value[:-1]),
        ("covariance", lambda value: -value),
        ("covariance", lambda value: value.sum()),
        ("share", lambda value: value + 5),
        ("share", lambda value: value - 5),
    ],
)
def test_a_state_with_damaged_attributes_is_refused(part, change):
    made = painted_map(4, 3)
    made.finish()
    state = made.state_dict()
    known = state["_extra_state"]["attributes"]
    known[f"colour.{part}"] = change(known[f"colour.{part}"])
    with pytest.raises(DataError, match="The state of the map is damaged"):
        gt.GaussianMap(FINE).load_state_dict(state)


def test_a_state_of_other_floating_types_is_read():
    made = painted_map(4, 3)
    made.finish()
    state = made.state_dict()
    known = state["_extra_state"]["attributes"]
    known["colour.slope"] = known["colour.slope"].float()
    again = gt.GaussianMap(FINE)
    again.load_state_dict(state)
    points = drive(4, 3)[0].points
    wanted = made.attributes(points)["colour"].mean
    torch.testing.assert_close(again.attributes(points)["colour"].mean, wanted, rtol=1e-4, atol=1e-4)


def test_more_channels_than_a_file_has_room_for_are_refused(tmp_path):
    with pytest.raises(InvalidArgumentError, match="17 channels"):
        scan_of(**{f"c{i}": torch.zeros(2) for i in range(17)})
    made = gt.GaussianMap(FINE)
    for first in (0, 9):
        points = drive(1, 3)[0].points
        channels = {f"c{first + i}": points[:, 0] for i in range(9)}
        made.insert(Scan(points, torch.zeros(3), attributes=channels))
    with pytest.raises(InvalidArgumentError, match="18 channels"):
        made.save(tmp_path / "map.gmm")


@pytest.mark.parametrize("codec", ["quantized", "float"])
def test_the_largest_values_and_most_channels_are_saved(tmp_path, codec):
    made = gt.GaussianMap(FINE, codec=codec)
    points = drive(1, 3)[0].points
    channels = {f"c{i}": torch.linspace(-1e12, 1e12, len(points)) for i in range(16)}
    made.insert(Scan(points, torch.zeros(3), attributes=channels))
    made.save(tmp_path / "map.gmm")
    again = gt.GaussianMap.load(tmp_path / "map.gmm")
    assert torch.equal(again.attributes(points)["c15"].mean, made.attributes(points)["c15"].mean)


def test_channels_follow_their_points():
    scan = scan_of(colour=np.array([[0, 128, 255], [255, 0, 0]], np.uint8), heat=[1.0, torch.nan])
    torch.testing.assert_close(scan.attributes["colour"][0], torch.tensor([0.0, 0.2158605, 1.0]))
    kept = scan.select(torch.tensor([False, True])).copied().transformed(torch.eye(4))
    assert kept.attributes["colour"].tolist() == [[1.0, 0.0, 0.0]]
    assert kept.attributes["heat"].isnan().all()


@given(st.floats(0, 1))
def test_display_colours_invert_linear_ones(value):
    given = torch.tensor([value], dtype=torch.float64)
    torch.testing.assert_close(linear_colours(display_colours(given)), given, rtol=1e-6, atol=1e-6)


@given(
    dim=st.sampled_from([2, 3]), width=st.integers(1, 8), k=st.integers(0, 20), seed=st.integers(0, 10**6),
    most=st.sampled_from([0, 1, 5, 1000, number_model.MOST_STEPS]),
)  # fmt: skip
def test_the_twin_writes_and_reads_the_numbers_of_the_kernel(dim, width, k, seed, most):
    rng = np.random.default_rng(seed)
    own = [rng.integers(-80, 81, (k, width)), rng.integers(-most, most + 1, (k, width * dim))]
    rows = torch.from_numpy(np.concatenate([rng.integers(0, 9, (k, 1)), *own], 1))
    rows[rows[:, 0] == 0] = 0
    twin, fused = by_both(lambda: number_model.write_rows(rows, width))
    assert twin == fused
    for found in by_both(lambda: number_model.read_rows(fused, k, rows.shape[1], width)):
        assert torch.equal(found, rows)


@given(data=st.binary(max_size=60), k=st.integers(0, 30), width=st.integers(1, 3))
def test_the_twin_and_the_kernel_agree_about_forged_numbers(data, k, width):
    def outcome() -> list[list[int]] | None:
        try:
            return number_model.read_rows(data, k, 1 + 4 * width, width).tolist()
        except DataError:
            return None

    twin, fused = by_both(outcome)
    assert twin == fused


def test_a_channel_far_from_zero_is_as_accurate_as_one_near_it(tmp_path):
    """Times of scans (s since 1970) in a map and its file, beside times since the first scan."""
    scans = drive(6)
    found = []
    for since in (0.0, 1.6e9):
        made = gt.GaussianMap(FINE)
        for number, scan in enumerate(scans):
            times = torch.full((len(scan.points),), since + 0.1 * number, dtype=torch.float64)
            made.insert(replace(scan, attributes={"time": times}))
        made.finish()
        made.save(tmp_path / "map.gmm")
        loaded = gt.GaussianMap.load(tmp_path / "map.gmm").attributes(scans[0].points)["time"]
        found.append((loaded.mean - since, loaded.variance.sqrt()))
    for near, far in zip(*found, strict=True):
        torch.testing.assert_close(near, far, atol=0.02, rtol=0)
