"""The main paths on a pretended GPU and on a real one: they mix no devices, and give the CPU's results."""

from __future__ import annotations

import pytest
import torch
from kernels.cones_for_kernels import cones_of
from kernels_of_gpu import kernels_of_gpu
from pretended_gpu import GPUTensor, pretended_gpu

import gmmtorch as gt
from gmmtorch import Evidence, VoxelGrid
from gmmtorch.kernels import kernels, traverse
from gmmtorch.linalg import on_cpu
from gmmtorch.mixture.em.exact import Parameters
from gmmtorch.mixture.em.truncated import Rows, group_rows, truncated_expectation
from gmmtorch.occupancy import Box, Cones, SparseEvidence, cast_evidence, flux_evidence, point_evidence

pytestmark = pytest.mark.cpu_only


def cloud(n: int = 4000) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(n, 3, generator=generator) * torch.tensor([4.0, 4.0, 2.0])
    points[torch.arange(n), torch.arange(n) % 3] = 0.01 * torch.randn(n, generator=generator)
    return points


def rays() -> tuple[torch.Tensor, torch.Tensor]:
    ends = cloud(500)
    return torch.tensor([[2.0, 2.0, 1.0]]).expand_as(ends).contiguous(), ends


def add_rays(device):
    origins, ends = (part.to(device) for part in rays())
    evidence = Evidence.empty(VoxelGrid((0.0, 0.0, 0.0), 0.2, (20, 20, 10)), device)
    evidence.add_rays(origins, ends)
    return evidence.hits, evidence.misses


def add_sparse_rays(device):
    origins, ends = (part.to(device) for part in rays())
    store = SparseEvidence(0.2, 3, device)
    store.add_rays(origins, ends)
    return store.in_key_order()


def cast_rays(device):
    origins, ends = (part.to(device) for part in rays())
    box = Box(torch.tensor([1, 1, 1], device=device), torch.tensor([15, 15, 8], device=device))
    is_hit = torch.ones(len(ends), dtype=torch.bool, device=device)
    return tuple(cast_evidence(origins, ends, is_hit, 0.2, box))


def ask_points(device):
    cones = Cones(*(part.to(device) for part in cones_of(3, "any")))
    return tuple(point_evidence(cones, 3 * cloud(1000).double().to(device) - 2, 0.1))


def grid_flux(device, tolerance=1e-2):
    cones = Cones(*(part.to(device) for part in cones_of(3, "any", 6)))
    found = flux_evidence(cones, VoxelGrid((-2.0,) * 3, 1.0, (4, 4, 4)), 3.0, tolerance=tolerance)
    return found.hits, found.misses


def exact_grid_flux(device):
    return grid_flux(device, 1e-6)


def fit_mixture(device):
    fitted = gt.GaussianMixture(10, random_state=0, max_iter=3, tol=1e9).fit(cloud(1000).to(device))
    return fitted.weights_, fitted.means_, fitted.covariances_


def build_and_ask_a_map(device):
    built = gt.GaussianMap(n_samples=300)
    for shift in (0.0, 0.1):
        points = cloud(300).to(device) + shift
        built.insert(gt.Scan(points, torch.tensor([2.0, 2.0, 1.0], device=device)))
    built.finish()
    asked = cloud(60).to(device)
    return built.means, built.occupancy(asked, 0.1), built.occupancy(asked, 0.2, method="monte_carlo")


def colour_a_map(device):
    """Learned, moved, measured in bytes and asked, with two channels."""
    built = gt.GaussianMap(n_samples=300)
    for shift in (0.0, 0.1):
        points = cloud(300).to(device) + shift
        channels = {"colour": (points / 5).clamp(0, 1), "class": (points[:, 0] > 2).long()}
        origin = torch.tensor([2.0, 2.0, 1.0], device=device)
        built.insert(gt.Scan(points, origin, attributes=channels))
    built.transform(torch.eye(4))
    found = built.attributes(cloud(60).to(device))
    size = torch.tensor(built.nbytes, device=device)
    return found["colour"].mean, found["class"].mean, found["class"].most_likely, size


def list_visits(device):
    origins, ends = (5 * part.to(device) for part in rays())
    total = torch.zeros(4000, device=device)  # of the numbers of the rays in each voxel
    for voxel, ray in traverse(origins, ends, (20, 20, 10)):
        total.index_add_(0, voxel, (1 + ray).float())
    return (total,)


def truncated_e_step(device):
    points = cloud(3000).double().to(device)
    rows = Rows(points, torch.ones(3000, dtype=torch.float64, device=device))
    covariances = 0.1 * torch.eye(3, dtype=torch.float64, device=device).repeat(40, 1, 1)
    mixture = Parameters(torch.full_like(points[:40, 0], 1 / 40), points[:40], covariances)
    groups = group_rows(rows, torch.arange(3000, device=device) % 40, mixture.means, torch.float64)
    candidates = (torch.arange(40, device=device)[:, None] + torch.arange(16, device=device)) % 40
    statistics, _, owner = truncated_expectation(groups, candidates, mixture, want_owner=True)
    return statistics, owner


def learn_depth_images(device):
    """Two windows of images of a wavy wall, and the predictions of the second."""
    row, column = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    frames = []
    for number in range(4):
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 0.3 * number
        depth = 2 + 0.3 * torch.sin(0.1 * column + 0.07 * row + 0.2 * number)
        depth[:4, number::7] = torch.nan
        frames.append((depth.to(device), pose))
    built = gt.GaussianMap(gt.IncrementalRule(noise=0.01, length=0.3, cell=0.05, window=2), codec="float")
    built.insert_depth(frames, [[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]], pixel_stride=1)
    found = built.unrounded()
    order = found.means[:, 0].argsort()
    coefficients = torch.tensor(built.query_options.calibration.coefficients, device=device)
    return found.means[order], found.covariances[order], found.support[order], coefficients


WORK = [
    add_rays,
    add_sparse_rays,
    cast_rays,
    ask_points,
    grid_flux,
    fit_mixture,
    pytest.param(build_and_ask_a_map, marks=pytest.mark.slow),
    pytest.param(colour_a_map, marks=pytest.mark.slow),
    pytest.param(learn_depth_images, marks=pytest.mark.slow),
]


@pytest.mark.parametrize("work", WORK)
def test_results_of_the_pretended_gpu_are_those_of_the_cpu(work):
    with kernels("torch"):
        expected = work("cpu")
    with pretended_gpu():
        found = work("cuda")
        assert all(isinstance(part, GPUTensor) for part in found)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.held, other, rtol=1e-5, atol=1e-5, check_dtype=False)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("choice", ["torch", "fused"])
@pytest.mark.parametrize("work", [*WORK, list_visits, exact_grid_flux, truncated_e_step])
def test_results_of_a_gpu_are_those_of_the_cpu(work, choice):
    with kernels("torch"):
        expected = work("cpu")
    with kernels(choice):
        found = work("cuda")
    assert {part.device.type for part in found} == {"cuda"}
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.cpu(), other, rtol=1e-5, atol=1e-5, check_dtype=False)


def test_the_pretended_gpu_refuses_what_a_gpu_refuses():
    with pretended_gpu() as gpu:
        x = torch.arange(3.0, device="cuda")
        assert (x.device.type, (2 * x).tolist()) == ("cuda", [0.0, 2.0, 4.0])
        with pytest.raises(RuntimeError, match="same device"):
            x + torch.ones(3)
        with pytest.raises(TypeError, match="cpu"):
            x.numpy()
        assert gpu.waits == {"tolist": 1}
        assert float(x.sum()) == 3.0
        assert x.cpu().numpy().sum() == 3.0
        assert gpu.waits == {"tolist": 1, "_local_scalar_dense": 1, "to cpu": 1}


def test_one_wait_brings_tensors_of_any_type_to_the_cpu():
    made = [torch.tensor([True, False, True]), torch.arange(5), torch.ones(2, 0), torch.rand(3, 2).T]
    made += [torch.rand(2, 3, dtype=torch.float64)[:, 0], torch.tensor(7, dtype=torch.int32)]
    with pretended_gpu() as gpu:
        found = on_cpu(*(tensor.to("cuda") for tensor in made))
        assert gpu.waits == {"to cpu": 1}
    for one, other in zip(found, made, strict=True):
        assert one.dtype == other.dtype
        assert torch.equal(one, other)


def test_a_gpu_waits_ten_times_for_the_first_scan():
    points, origin = cloud(20_000).double(), torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64)

    def inserted(scan):
        made = gt.GaussianMap(gt.IncrementalRule(noise=0.01, length=0.5, cell=0.05, window=1))
        made.insert(scan)
        return made.components()

    with kernels("torch"):
        expected = inserted(gt.Scan(points, origin))
    with pretended_gpu() as gpu:
        scan = gt.Scan(points.to("cuda"), origin.to("cuda"))
        gpu.waits.clear()
        found = inserted(scan)
        assert gpu.waits.total() == 10  # one of them for the mean range, of the first window alone
    for name, values in expected.tensors().items():
        torch.testing.assert_close(getattr(found, name).held, values)


@pytest.mark.parametrize("devices", [("cuda", "cpu"), ("cpu", "cuda")])
def test_a_state_goes_to_the_device_of_the_map_that_loads_it(devices):
    scan = gt.Scan(cloud(500).double(), torch.tensor([2.0, 2.0, 1.0], dtype=torch.float64))

    def built(device):
        made = gt.GaussianMap(gt.IncrementalRule(noise=0.01, length=0.5, cell=0.05, window=3))
        made.insert(scan.to(device))
        return made

    with kernels("torch"):
        expected = built("cpu")
        expected.insert(scan)
    with pretended_gpu():
        saved, loaded = map(built, devices)
        loaded.load_state_dict(saved.state_dict())
        loaded.insert(scan.to(devices[1]))
        found = loaded.components().on_cpu()
    for name, values in expected.components().tensors().items():
        torch.testing.assert_close(getattr(found, name), values)


@pytest.mark.parametrize(
    ("work", "most_bytes"),
    [(list_visits, 20_000), (ask_points, 300_000), (exact_grid_flux, 20_000), (truncated_e_step, 400_000)],
)
def test_work_goes_on_in_smaller_chunks_where_the_memory_of_the_gpu_ends(work, most_bytes, caplog):
    caplog.set_level("INFO")
    with kernels("torch"):
        expected = work("cpu")
    with pretended_gpu() as gpu:
        gpu.most_bytes = most_bytes
        found = work("cuda")
    assert "GPU 0 is out of memory" in caplog.text
    assert "chunks of" in caplog.text
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.held, other, rtol=1e-9, atol=1e-12)


@pytest.mark.slow  # a C++ compiler takes seconds for each kernel
@pytest.mark.parametrize("work", [*WORK, list_visits, exact_grid_flux, truncated_e_step])
def test_the_kernels_of_a_gpu_give_the_results_of_the_cpu(work):
    with kernels("torch"):
        expected = work("cpu")
    with pretended_gpu(), kernels_of_gpu():
        found = work("cuda")
        assert all(isinstance(part, GPUTensor) for part in found)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one.held, other, rtol=1e-5, atol=1e-5, check_dtype=False)
