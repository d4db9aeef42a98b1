"""Codecs of points: decoded points are within the error limit of each codec."""

from __future__ import annotations

import importlib
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from torch import Tensor

from gmmtorch.errors import DataError, GmmTorchError, InvalidArgumentError
from gmmtorch.team.sharing import POINT_CODECS, bytes_of_points
from gmmtorch.team.sharing.point_codecs import (
    DepthImage,
    Draco,
    Octree,
    PointCodec,
    QuantizedPoints,
    RawPoints,
    point_codec,
)

pytest.importorskip("zstandard")
pytest.importorskip("DracoPy")

clouds = st.builds(
    lambda n, seed, center, extent: cloud(n, seed, center, extent),
    n=st.integers(0, 300),
    seed=st.integers(0, 999),
    center=st.sampled_from([0.0, -41.3, 5e5]),
    extent=st.sampled_from([0.0, 0.05, 6.0, 300.0]),
)
resolutions = st.sampled_from([0.001, 0.05, 0.2, 1.0, 10.0])


def cloud(n: int, seed: int = 0, center: float = 0.0, extent: float = 6.0) -> Tensor:
    """Points on a wall and a floor."""
    generator = torch.Generator().manual_seed(seed)
    points = torch.rand(n, 3, generator=generator, dtype=torch.float64) * extent
    points[: n // 2, 0] = extent / 3
    points[n // 2 :, 2] = 0.0
    return points + center


def sorted_rows(rows: np.ndarray) -> np.ndarray:
    return rows[np.lexsort(rows.T)]


def cells_of(points: Tensor, resolution: float) -> np.ndarray:
    """The lattice cell of each point, one point at a time."""
    return np.array([[math.floor(x / resolution) for x in row] for row in points.tolist()]).reshape(-1, 3)


@given(points=clouds)
def test_raw_points_are_float32_in_order(points):
    if points.numel() and float(points.abs().max()) > 16384:
        with pytest.raises(InvalidArgumentError, match="millimetre"):
            RawPoints().encode(points)
        return
    data = RawPoints().encode(points)
    assert len(data) == 12 * len(points)
    assert torch.equal(RawPoints().decode(data), points.float().double())


@given(points=clouds, resolution=resolutions)
def test_every_point_is_decoded_as_its_cell_centre(points, resolution):
    codec = QuantizedPoints(resolution)
    found = codec.decode(codec.encode(points)).numpy()
    expected = (cells_of(points, resolution) + 0.5) * resolution
    np.testing.assert_array_equal(sorted_rows(found), sorted_rows(expected))


@given(points=clouds, resolution=resolutions)
def test_an_octree_holds_each_cell_once(points, resolution):
    codec = Octree(resolution)
    found = codec.decode(codec.encode(points)).numpy()
    expected = (np.unique(cells_of(points, resolution), axis=0).reshape(-1, 3) + 0.5) * resolution
    np.testing.assert_array_equal(sorted_rows(found), sorted_rows(expected))


@settings(max_examples=60)
@given(points=clouds, error=st.sampled_from([0.002, 0.01, 0.1, 1.0]))
def test_draco_errors_are_within_the_limit(points, error):
    codec = Draco(error)
    found = codec.decode(codec.encode(points))
    assert len(found) <= len(points)  # equal ones become one
    if len(points):
        # Draco does not keep the order; the nearest point is at most as far as the own one.
        for one, other in ((points, found), (found, points)):
            distances = cKDTree(other.numpy()).query(one.numpy())[0]
            assert math.sqrt(np.square(distances).mean()) <= error * (1 + 1e-3) + 1e-5


def test_draco_uses_the_coarsest_allowed_quantization():
    """Points so far apart that the nearest decoded point is their own."""
    points = torch.rand(3000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 60
    for error in (0.005, 0.1):
        found = Draco(error).decode(Draco(error).encode(points)).numpy()
        distance = cKDTree(found).query(points.numpy())[0]
        assert len(found) == 3000
        assert 0.95 * error <= math.sqrt(np.square(distance).mean()) <= error * (1 + 1e-4)


@given(
    shape=st.tuples(st.integers(0, 20), st.integers(0, 30)),
    seed=st.integers(0, 99),
    share=st.sampled_from([0.0, 0.3, 1.0]),
    farthest=st.sampled_from([0.01, 6.0, 65.0]),
    step=st.sampled_from([0.001, 0.0125, 0.2]),
)
def test_depths_are_decoded_in_whole_steps(shape, seed, share, farthest, step):
    generator = torch.Generator().manual_seed(seed)
    depths = step + torch.rand(shape, generator=generator, dtype=torch.float64) * farthest
    depths[torch.rand(shape, generator=generator) >= share] = 0.0
    codec = DepthImage(step=step)
    found = codec.decode(codec.encode(depths))
    assert torch.equal(found, (depths * (1 / step)).round() / (1 / step))
    assert torch.equal(found > 0, depths > 0)


def test_compressed_points_are_smaller_than_raw_and_the_octree_is_smallest():
    points = cloud(5000)
    depths = torch.zeros(120, 160, dtype=torch.float64)
    depths.view(-1)[:5000] = 2 + torch.arange(5000, dtype=torch.float64) / 1e4
    sizes = bytes_of_points(points, 0.2, 0.1, depths)
    assert sizes["raw"] == 60000
    assert list(sizes) == [*POINT_CODECS, "depth_image"]
    assert sizes["octree"] < min(sizes["quantized"], sizes["draco"])
    assert max(sizes["quantized"], sizes["draco"], sizes["depth_image"]) < 0.2 * sizes["raw"]
    for name in POINT_CODECS:
        assert sizes[name] == len(point_codec(name, 0.2, 0.1).encode(points))


def test_no_points_take_no_bytes():
    nothing = bytes_of_points(torch.zeros(0, 3), 0.2, 0.1, torch.zeros(4, 4), ["octree", "draco"])
    assert nothing == {"octree": 0, "draco": 0, "depth_image": 0}


# -- what cannot be encoded or decoded -------------------------------------------------------------------


@pytest.mark.parametrize("name", POINT_CODECS)
@pytest.mark.parametrize(
    "points", [torch.full((3, 3), math.nan), torch.full((3, 3), math.inf), torch.zeros(3, 2), torch.zeros(3)]
)
def test_invalid_points_are_refused(name, points):
    with pytest.raises(InvalidArgumentError, match="points"):
        point_codec(name, 0.2, 0.1).encode(points)


@pytest.mark.parametrize("codec", [QuantizedPoints(0.001), Octree(0.001), Draco(1e-7)])
def test_points_too_far_apart_for_the_step_are_refused(codec):
    with pytest.raises(InvalidArgumentError, match=r"coarser|larger error"):
        codec.encode(torch.tensor([[0.0, 0.0, 0.0], [1e6, 0.0, 0.0]]))


@pytest.mark.parametrize("depth", [math.nan, -1.0, 65.6, math.inf])
def test_invalid_depths_are_refused(depth):
    with pytest.raises(InvalidArgumentError, match="depths"):
        DepthImage().encode(torch.full((2, 2), depth))


def test_invalid_codec_options_are_refused():
    for make, message in (
        (lambda: Draco(0.0), "error=0.0"),
        (lambda: Draco(math.nan), "error=nan"),
        (lambda: Octree(0.0), "resolution"),
        (lambda: QuantizedPoints(-1.0), "resolution"),
        (lambda: DepthImage(step=0.0), "step=0.0"),
        (lambda: DepthImage(step=math.nan), "step=nan"),
        (lambda: point_codec("zip", 0.2, 0.1), "'zip' is not one of raw"),
    ):
        with pytest.raises(InvalidArgumentError, match=message):
            make()


def test_bytes_that_are_not_of_draco_are_refused():
    pytest.importorskip("DracoPy")
    data = Draco(0.05).encode(cloud(20))
    for other in (data[:-60], data[:20], data[:17] + b"PLY" + data[20:]):
        with pytest.raises(DataError, match="Draco"):
            Draco(0.05).decode(other)


def test_damaged_bytes_are_refused_or_decode_to_points():
    """Draco's own reader is not put to this: it may end the process."""
    rng = np.random.default_rng(0)
    depths = torch.rand(12, 16, dtype=torch.float64)
    codecs: list[tuple[PointCodec | DepthImage, bytes]] = [
        (codec, codec.encode(cloud(150))) for codec in (RawPoints(), QuantizedPoints(0.05), Octree(0.05))
    ]
    codecs.append((DepthImage(), DepthImage().encode(depths)))
    n_refused = 0
    for trial in range(1500):
        codec, data = codecs[trial % len(codecs)]
        damaged = bytearray(data[: rng.integers(0, len(data))] if trial % 3 == 0 else data)
        for place in rng.integers(0, max(len(damaged), 1), 3)[: len(damaged)]:
            damaged[place] = rng.integers(0, 256)
        try:
            assert bool(torch.isfinite(codec.decode(bytes(damaged))).all())
        except DataError:
            n_refused += 1
    assert n_refused > 300


@pytest.mark.parametrize(("codec", "library"), [(Octree(0.2), "zstandard"), (Draco(0.1), "DracoPy")])
def test_a_missing_library_is_reported_with_its_extra(codec, library, monkeypatch):
    def missing(name: str) -> None:
        raise ImportError(f"No module named {name!r}")

    monkeypatch.setattr(importlib, "import_module", missing)
    with pytest.raises(GmmTorchError, match=rf"{library}.*gmmtorch\[baselines\]"):
        codec.encode(cloud(10))
