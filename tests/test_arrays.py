"""Public functions take every kind of array of real numbers, and refuse all others with one kind of error."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import scipy.sparse
import torch

import gmmtorch as gt
from gmmtorch import GmmTorchError, baselines, register, simulation
from gmmtorch.arrays import as_tensor
from gmmtorch.datasets import Ranges
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.mapping.surfaces import clearance, expected_returns
from gmmtorch.mixture import DepthCameraModel, LaserModel, Parameters, merge, prune, score_stream, simplify
from gmmtorch.occupancy import (
    Boundary,
    Box,
    ConeIndex,
    Cones,
    RollingWindow,
    SparseEvidence,
    Thresholds,
    box_flux,
    cast_evidence,
    cone_evidence,
    expected_range,
    occupancy_probability,
    point_evidence,
    sample_rays,
)


def whole(*shape: int, low: int = -4, high: int = 5, seed: int = 0) -> np.ndarray:
    """Whole numbers as float64: every real type represents them exactly."""
    return np.random.default_rng(seed).integers(low, high, shape).astype(np.float64)


POINTS = whole(40, 2)
QUERIES = whole(6, 2, seed=1)
ORIGIN = np.array([9.0, 1.0])
MEANS, ORIGINS = whole(3, 2, seed=2), whole(3, 2, low=8, high=12)
COVARIANCES = np.stack([np.array([[2.0, 1.0], [1.0, 3.0]])] * 3)
SUPPORT = np.array([9.0, 20.0, 30.0])
WEIGHTS = np.array([0.25, 0.25, 0.5])  # exact in every floating type
LOW, HIGH = np.array([[0.0, 0.0], [1.0, 2.0]]), np.array([[1.0, 2.0], [2.0, 4.0]])
POLYGON = np.array([[0.0, 0.0], [4.0, 0.0], [1.0, 3.0]])
DEPTH = 1.0 + np.add.outer(np.arange(64) // 16, np.arange(96) // 24).astype(np.float64)
INTRINSICS = np.array([[80.0, 0.0, 48.0], [0.0, 75.0, 32.0], [0.0, 0.0, 1.0]])
POSE3, POSE2 = np.diag([-1.0, -1.0, 1.0, 1.0]), np.diag([-1.0, -1.0, 1.0])
FLAGS = np.array([0.0, 1.0, 0.0])
PLACES = whole(3, 3, seed=3)
SEGMENTS = whole(4, 2, 2, seed=4)
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def given_map() -> gt.GaussianMap:
    return gt.GaussianMap.from_components(MEANS, COVARIANCES, SUPPORT, ORIGINS)


def cones(**fields: Any) -> Cones:
    return Cones(MEANS, COVARIANCES, ORIGINS, SUPPORT, FLAGS)._replace(**fields)


def mixture(means: Any = MEANS) -> gt.GaussianMixture:
    return gt.GaussianMixture.from_parameters(WEIGHTS, means, COVARIANCES)


def inserted(made: Any, points: Any = POINTS, origin: Any = ORIGIN) -> np.ndarray:
    made.insert(gt.Scan(points, origin))
    return made.occupancy(QUERIES)


def depth_map(depth: Any = DEPTH, pose: Any = POSE3, intrinsics: Any = INTRINSICS) -> torch.Tensor:
    made = gt.GaussianMap(gt.IncrementalRule(noise=0.01, length=0.5, cell=0.25))
    made.insert_depth([(depth, pose)], intrinsics, pixel_stride=8, depth_scale=1.0)
    return made.support.sum()


def rays(**fields: Any) -> torch.Tensor:
    given = {"origins": ORIGINS, "ends": MEANS, "weights": SUPPORT, "is_hit": FLAGS, **fields}
    evidence = gt.Evidence.empty(gt.VoxelGrid((-5, -5), 1.0, (20, 20)))
    evidence.add_rays(**given)
    return torch.stack([evidence.hits, evidence.misses])


def sparse_rays(**fields: Any) -> torch.Tensor:
    given = {"origins": ORIGINS, "ends": MEANS, "weights": SUPPORT, "is_hit": FLAGS, **fields}
    evidence = SparseEvidence(1.0, 2)
    evidence.add_rays(**given)
    return torch.cat(evidence.in_key_order())


def cast_rays(**fields: Any) -> torch.Tensor:
    given = {"origins": PLACES[0], "ends": PLACES, "is_hit": FLAGS, "weights": SUPPORT, **fields}
    box = Box(torch.full((3,), -9), torch.full((3,), 9))
    return torch.stack(cast_evidence(resolution=0.5, box=box, **given)[1:])


def window_at(position: Any) -> torch.Tensor:
    window = RollingWindow(0.5, (8, 8, 8), 2)
    window.center_on(position)
    return torch.stack(window.around(position, (4, 4, 4), 2))


def components(**fields: Any) -> torch.Tensor:
    parts = {**vars(given_map().components()), **fields}
    return gt.Components(**parts).cones().covariances


@dataclass
class Case:
    """A function of one array, and a valid array of float64."""

    call: Callable[[Any], Any]
    value: np.ndarray
    errors: tuple[type[Exception], ...] = (GmmTorchError,)


def simplified(value: Any, place: int) -> torch.Tensor:
    parts: list[Any] = [WEIGHTS, MEANS, COVARIANCES]
    parts[place] = value
    return simplify(Parameters(*parts), 2).parameters.means


SKLEARN = (GmmTorchError, ValueError, TypeError)  # its checks of X come first

CASES = {
    "Scan.points": Case(lambda x: gt.Scan(x, ORIGIN).points, POINTS),
    "Scan.origin": Case(lambda x: gt.Scan(POINTS, x).origin, ORIGIN),
    "Scan.no_return": Case(lambda x: gt.Scan(POINTS, ORIGIN, x).no_return, POINTS),
    "Scan.transformed": Case(lambda x: gt.Scan(POINTS, ORIGIN).transformed(x).points, POSE2),
    "GaussianMap.insert": Case(lambda x: inserted(gt.GaussianMap(window=1), x), POINTS),
    "GaussianMap.insert_depth": Case(depth_map, DEPTH),
    "GaussianMap.insert_depth pose": Case(lambda x: depth_map(pose=x), POSE3),
    "GaussianMap.insert_depth intrinsics": Case(lambda x: depth_map(intrinsics=x), INTRINSICS),
    "GaussianMap.occupancy": Case(lambda x: given_map().occupancy(x), QUERIES),
    "GaussianMap.transform": Case(lambda x: moved(x), POSE2),
    "from_components.means": Case(lambda x: made_of(means=x), MEANS),
    "from_components.covariances": Case(lambda x: made_of(covariances=x), COVARIANCES),
    "from_components.support": Case(lambda x: made_of(support=x), SUPPORT),
    "from_components.origins": Case(lambda x: made_of(origins=x), ORIGINS),
    "from_components.max_range": Case(lambda x: made_of(max_range=x), FLAGS),
    "Components.covariances": Case(lambda x: components(covariances=x), COVARIANCES),
    "OccupancyGrid.insert": Case(lambda x: inserted(baselines.OccupancyGrid(0.5), x), POINTS),
    "NDTMap.occupancy": Case(lambda x: baselines.NDTMap(1.0).occupancy(x), QUERIES),
    "VoxelGrid.origin": Case(lambda x: torch.tensor(gt.VoxelGrid(x, 1.0, (2, 2)).origin), ORIGIN),
    "VoxelGrid.covering": Case(lambda x: torch.tensor(gt.VoxelGrid.covering(x, [20, 20], 1).origin), ORIGIN),
    "Evidence.add_rays origins": Case(lambda x: rays(origins=x), ORIGINS),
    "Evidence.add_rays ends": Case(lambda x: rays(ends=x), MEANS),
    "Evidence.add_rays weights": Case(lambda x: rays(weights=x), SUPPORT),
    "Evidence.add_rays is_hit": Case(lambda x: rays(is_hit=x), FLAGS),
    "Evidence.hits": Case(lambda x: gt.Evidence(gt.VoxelGrid((0, 0), 1, (3, 2)), x, x).probability(), MEANS),
    "SparseEvidence.add_rays origins": Case(lambda x: sparse_rays(origins=x), ORIGINS),
    "SparseEvidence.add_rays ends": Case(lambda x: sparse_rays(ends=x), MEANS),
    "SparseEvidence.add_rays weights": Case(lambda x: sparse_rays(weights=x), SUPPORT),
    "SparseEvidence.add_rays is_hit": Case(lambda x: sparse_rays(is_hit=x), FLAGS),
    "SparseEvidence.lookup": Case(lambda x: SparseEvidence(1.0, 2).lookup(x), QUERIES),
    "cast_evidence origins": Case(lambda x: cast_rays(origins=x), PLACES),
    "cast_evidence ends": Case(lambda x: cast_rays(ends=x), PLACES),
    "cast_evidence is_hit": Case(lambda x: cast_rays(is_hit=x), FLAGS),
    "cast_evidence weights": Case(lambda x: cast_rays(weights=x), SUPPORT),
    "cast_evidence hit_places": Case(lambda x: cast_rays(hit_places=(x, SUPPORT)), PLACES),
    "RollingWindow": Case(lambda x: window_at(x), PLACES[0]),
    "occupancy_probability": Case(lambda x: occupancy_probability(x, SUPPORT), SUPPORT),
    "Thresholds.classify": Case(lambda x: Thresholds().classify(x), FLAGS),
    "Ranges.scan": Case(lambda x: Ranges(6.0, 2.0).scan(x, ORIGIN).no_return, POINTS),
    "Ranges.scan origin": Case(lambda x: Ranges(6.0, 2.0).scan(POINTS, x).points, ORIGIN),
    "sensor noise points": Case(lambda x: LaserModel().noise_covariances(x, ORIGIN), POINTS),
    "sensor noise normals": Case(lambda x: LaserModel().noise_covariances(MEANS, ORIGIN, x), LOW[[1, 1, 1]]),
    "sensor point_density": Case(lambda x: DepthCameraModel().point_density(x, 0.5), SUPPORT),
    "sensor deviations": Case(lambda x: DepthCameraModel().deviations(x).along, SUPPORT),
    "ray_segments": Case(lambda x: nearness(simulation.ray_segments(ORIGINS, MEANS - ORIGINS, x)), SEGMENTS),
    "MeshWorld.distances": Case(
        lambda x: nearness(simulation.MeshWorld(TETRAHEDRON[FACES]).distances(x, TETRAHEDRON[1:] + 0.25)),
        PLACES[0],
    ),
    "smooth_path": Case(lambda x: simulation.smooth_path(x), POLYGON),
    "poses_2d": Case(lambda x: simulation.poses_2d(x, 3), POLYGON),
    "simulate_scan": Case(lambda x: sensed(x).points, POSE2),
    "fit_stream": Case(lambda x: gt.fit_stream(mixture_of(3), x).means, POINTS),
    "score_stream": Case(lambda x: torch.tensor(score_stream(mixture(), x)[0]), QUERIES),
    "Evidence.lookup": Case(lambda x: gt.Evidence.empty(gt.VoxelGrid((0, 0), 1, (2, 2))).lookup(x), QUERIES),
    "box_flux.low": Case(lambda x: torch.stack(box_flux(cones(), x, HIGH)), LOW),
    "box_flux cones": Case(lambda x: torch.stack(box_flux(cones(means=x), LOW, HIGH)), MEANS),
    "cone_evidence.high": Case(lambda x: torch.stack(cone_evidence(cones(), LOW, x)), HIGH),
    "point_evidence": Case(lambda x: torch.stack(point_evidence(cones(), x, 0.5)), QUERIES),
    "sample_rays": Case(lambda x: sample_rays(cones(covariances=x), 20).ends, COVARIANCES),
    "ConeIndex": Case(lambda x: ConeIndex(cones(origins=x), 1.0).hulls.table, ORIGINS),
    "Boundary.of_polygon": Case(lambda x: Boundary.of_polygon(x).edges, POLYGON),
    "noise_covariances": Case(lambda x: deconvolved(x).means, COVARIANCES[0]),
    "expected_range": Case(lambda x: expected_range(cones(), x, MEANS + 1, 9.0, 0.5).mean, ORIGINS),
    "clearance": Case(lambda x: clearance(given_map(), x), QUERIES),
    "expected_returns": Case(lambda x: expected_returns((x, COVARIANCES, SUPPORT), QUERIES, 0.5), MEANS),
    "register": Case(lambda x: register(given_map(), given_map(), x).transform, np.eye(3)),
    "simplify.weights": Case(lambda x: simplified(x, 0), SUPPORT),
    "simplify.means": Case(lambda x: simplified(x, 1), MEANS),
    "simplify.covariances": Case(lambda x: simplified(x, 2), COVARIANCES),
    "prune": Case(lambda x: prune(Parameters(WEIGHTS, x, COVARIANCES), 9, min_support=3)[0].means, MEANS),
    "fit_depth_image": Case(lambda x: gt.fit_depth_image(x, INTRINSICS, 3, depth_scale=1.0).means, DEPTH),
    "fit_depth_image intrinsics": Case(lambda x: gt.fit_depth_image(DEPTH, x, 3).means, INTRINSICS),
    "GaussianMixture.fit": Case(lambda x: fitted(x).means, POINTS, SKLEARN),
    "GaussianMixture.fit weight": Case(lambda x: fitted(POINTS, x).means, whole(40, low=1)),
    "GaussianMixture.score_samples": Case(lambda x: mixture().score_samples(x), QUERIES, SKLEARN),
    "from_parameters": Case(lambda x: mixture(x).means, MEANS),
    "GaussianMixture.moved": Case(lambda x: mixture().moved(x).means, POSE2),
}


def nearness(distance: torch.Tensor) -> torch.Tensor:
    """1/t, which is finite for rays that hit nothing."""
    return 1 / distance


def sensed(pose: Any) -> gt.Scan:
    world = simulation.World2D(torch.from_numpy(SEGMENTS), torch.zeros(2, 2))
    return simulation.simulate_scan(simulation.laser_2d(9), pose, world, torch.Generator().manual_seed(0))


def mixture_of(k: int) -> gt.GaussianMixture:
    return gt.GaussianMixture(k, algorithm="exact", random_state=0, max_iter=2, tol=0.0)


def fitted(X: Any, weight: Any = None) -> gt.GaussianMixture:
    return gt.GaussianMixture(2, random_state=0, max_iter=3, tol=0.0).fit(X, sample_weight=weight)


def made_of(**parts: Any) -> np.ndarray:
    given = {"means": MEANS, "covariances": COVARIANCES, "support": SUPPORT, "origins": ORIGINS}
    return gt.GaussianMap.from_components(**{**given, **parts}).occupancy(QUERIES)


def deconvolved(noise: Any) -> gt.DeconvolvedGaussianMixture:
    made = gt.DeconvolvedGaussianMixture(1, random_state=0, max_iter=2, tol=0.0)
    return made.fit(POINTS, noise_covariances=noise)


def moved(transform: Any) -> torch.Tensor:
    made = given_map()
    made.transform(transform)
    return made.means


def strided(x: np.ndarray) -> np.ndarray:
    """The same values behind strides of −2 along every axis."""
    every_second = np.zeros([2 * n for n in x.shape])
    view = every_second[tuple(slice(None, None, -2) for _ in x.shape)]
    view[...] = x
    assert min(view.strides) < 0
    return view


def read_only(x: np.ndarray) -> np.ndarray:
    copy = x.copy()
    copy.flags.writeable = False
    return copy


GOOD: dict[str, Callable[[np.ndarray], Any]] = {
    "float32": lambda x: x.astype(np.float32),
    "float16": lambda x: x.astype(np.float16),
    "int32": lambda x: x.astype(np.int32),
    "big endian": lambda x: x.astype(">f4"),
    "longdouble": lambda x: x.astype(np.longdouble),
    "strides": strided,
    "Fortran": np.asfortranarray,
    "read only": read_only,
    "list": np.ndarray.tolist,
    "list of rows": list,
    "tensor": torch.from_numpy,
    "half tensor": lambda x: torch.from_numpy(x).half(),
    "whole tensor": lambda x: torch.from_numpy(x).long(),
    "gradient": lambda x: torch.from_numpy(x).requires_grad_(),
}
BAD: dict[str, Callable[[np.ndarray], Any]] = {
    "masked": lambda x: np.ma.masked_less(x, x.max()),
    "complex": lambda x: x + 1j,
    "complex tensor": lambda x: torch.from_numpy(x + 1j),
    "object": lambda x: np.full(x.shape, None),
    "strings": lambda x: np.full(x.shape, "a"),
    "text": lambda x: "points.npy",
    "sparse tensor": lambda x: torch.from_numpy(x).to_sparse(),
}
ROUNDING = {"half tensor": 1e-3}  # tensors in give tensors of the same type


def as_array(value: Any) -> np.ndarray:
    return np.asarray(value.detach() if isinstance(value, torch.Tensor) else value, np.float64)


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
def test_every_kind_of_array_gives_the_result_of_float64(case):
    expected = as_array(case.call(case.value))
    assert np.isfinite(expected).all()
    for kind, made in GOOD.items():
        found = as_array(case.call(made(case.value)))
        np.testing.assert_allclose(found, expected, rtol=ROUNDING.get(kind, 1e-4), atol=1e-5, err_msg=kind)


@pytest.mark.parametrize("case", CASES.values(), ids=list(CASES))
def test_what_is_no_array_of_numbers_is_refused(case):
    for kind, made in BAD.items():
        try:
            case.call(made(case.value))
        except case.errors:
            continue
        pytest.fail(f"{kind} is accepted")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.ma.masked_array([1.0, 2.0], [False, True]), r"^x is a masked array.*x\.filled"),
        ([np.ma.masked_array([1.0, 2.0], [False, True])], r"^x\[0\] is a masked array"),
        (np.array([1j]), r"^x is complex \(complex128\); give real numbers, such as x\.real"),
        (torch.tensor([1j]), r"^x is complex"),
        (np.array(["1"]), r"^x is a ndarray of dtype <U1, not an array of numbers"),
        ([[1, 2], [3]], r"^x is a list that is not an array of numbers.*same length"),
        ([torch.zeros(2), torch.zeros(3)], r"^x has parts of shapes \(2,\), \(3,\)"),
        (None, r"^x is a NoneType of dtype object"),
        (np.array(["2020-01-01"], dtype="datetime64[D]"), r"^x is a ndarray of dtype datetime64"),
        (scipy.sparse.eye_array(2, format="csr"), r"^x is sparse, a csr_array; give x\.toarray"),
        (torch.eye(2).to_sparse(), r"^x is a torch.sparse_coo tensor; give x\.to_dense"),
    ],
)
def test_errors_name_the_argument_and_the_remedy(value, message):
    with pytest.raises(InvalidArgumentError, match=message):
        as_tensor(value, "x")


def test_large_unsigned_numbers_and_lists_keep_their_values():
    assert as_tensor(np.array([2**32 - 1], np.uint32), "x", torch.int64).tolist() == [2**32 - 1]
    assert as_tensor(np.array([2**63], np.uint64), "x").tolist() == [2.0**63]
    assert as_tensor([0.1, 16_777_217], "x").tolist() == [0.1, 16_777_217]
    assert as_tensor([torch.tensor(0.5), 2], "x").tolist() == [0.5, 2]


def test_the_faces_of_a_mesh_are_arrays_of_whole_numbers():
    edges = Boundary.of_mesh(TETRAHEDRON, FACES.tolist()).edges
    for faces in (FACES, FACES.astype(">u2"), torch.from_numpy(FACES)):
        assert torch.equal(Boundary.of_mesh(TETRAHEDRON, faces).edges, edges)
    with pytest.raises(InvalidArgumentError, match=r"triangles.*whole numbers"):
        Boundary.of_mesh(TETRAHEDRON, FACES.astype(float))


def test_gradients_flow_through():
    x = torch.ones(2, requires_grad=True)
    as_tensor([x, 2 * x], "x").sum().backward()
    assert x.grad.tolist() == [3, 3]


def test_estimators_are_reduced_as_their_parameters_are():
    expected = simplify(Parameters(WEIGHTS, MEANS, COVARIANCES), 2).parameters
    found = simplify(mixture(), 2).parameters
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    for call in (lambda: simplify(MEANS, 2), lambda: merge(MEANS, mixture(), 1, 1), lambda: prune("a", 1)):
        with pytest.raises(InvalidArgumentError, match="give a fitted mixture"):
            call()


def test_evidence_says_which_shape_does_not_match():
    wrong = {"ends": MEANS[:, :1], "weights": SUPPORT[:2], "is_hit": FLAGS[:1], "origins": ORIGIN}
    for name, value in wrong.items():
        with pytest.raises(InvalidArgumentError, match=rf"^{name} has shape"):
            rays(**{name: value})


def test_the_attributes_of_an_empty_map_say_that_it_is_empty():
    with pytest.raises(AttributeError, match=r"^means: the map is empty; insert a scan first"):
        _ = gt.GaussianMap().means
    assert not hasattr(gt.GaussianMap(), "no_such_name")


@pytest.mark.parametrize("resolution", ["0.1", None, 1e300, float("inf"), 0, -1.0])
def test_a_resolution_that_is_no_cell_size_is_refused(resolution):
    for call in (
        lambda: gt.VoxelGrid((0, 0), resolution, (2, 2)),
        lambda: gt.GaussianMap(resolution=resolution),
        lambda: gt.OccupancyGrid(resolution),
    ):
        with pytest.raises(InvalidArgumentError, match=r"^resolution=.* is not a cell size"):
            call()
    with pytest.raises(InvalidArgumentError, match=r"^prior='1'"):
        gt.GaussianMap(prior="1")


def test_a_streamed_fit_without_an_estimator_says_what_it_wants():
    with pytest.raises(InvalidArgumentError, match="mixture is a ndarray; give a GaussianMixture"):
        gt.fit_stream(POINTS, 3)


def test_repr_says_in_one_line_what_matters():
    scan = gt.Scan(POINTS, ORIGIN, POINTS[:3])
    grid = gt.VoxelGrid((0, 1), 0.5, (2, 4))
    evidence = gt.Evidence.empty(grid)
    evidence.add_rays([[0.1, 1.1]], [[0.1, 1.6]])
    assert repr(scan) == (
        "Scan(40 points and 3 no-return beams in 2D from (9, 1) m, x -4 to 4, y -4 to 4 m, torch.float64, "
        "cpu)"
    )
    assert repr(grid) == "VoxelGrid(2 × 4 cells of 0.5 m, x 0 to 1, y 1 to 3 m)"
    assert (
        repr(evidence) == f"Evidence(2 of 8 cells seen, 1 hits, 1 misses, 128 bytes, prior 1, cpu, {grid!r})"
    )
    known = repr(given_map().components())
    assert known.startswith("Components(3 in 2D seen from 3 origins, x ")
    assert known.endswith(" m, 59 points, 339 bytes in memory, cpu)")
    assert repr(given_map()).startswith("GaussianMap(3 components in 2D, x ")
    for text in (scan, grid, evidence, given_map(), given_map().components(), gt.Components.empty(3)):
        assert "\n" not in repr(text)


@pytest.mark.parametrize("name", ["cuda", "cuda:99", "abacus"])
def test_a_device_that_torch_does_not_have_is_named_with_the_remedy(name):
    if name == "cuda" and torch.cuda.is_available():
        pytest.skip("there is a GPU")
    points = torch.rand(40, 3, dtype=torch.float64)
    mixture, scan = gt.GaussianMixture(2).fit(points), gt.Scan(points, torch.zeros(3))
    learned = gt.GaussianMap()
    learned.insert(scan)
    moves = [thing.to for thing in (mixture, learned, learned.components(), scan)]
    for move in (*moves, lambda device: as_tensor(points, "points", device=device)):
        with pytest.raises(InvalidArgumentError, match=rf"device={name} is not available .*use cpu"):
            move(name)
    if name == "cuda":
        with pytest.raises(InvalidArgumentError, match="device=cuda is not available"):
            mixture.cuda()
    assert mixture.to(torch.float32).means.dtype == torch.float64
