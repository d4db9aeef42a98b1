"""`runtime.kernels`: which kernels run, and what happens without a compiler or a cache folder."""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import time

import pytest
import torch

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.kernels import choice, compiler, kernels, use_kernels

pytestmark = pytest.mark.cpu_only

ONE = torch.ones(1)


@pytest.fixture
def no_compiler(monkeypatch):
    monkeypatch.setattr(compiler, "compiler_failure", lambda *_: "the package warp-lang does not load (test)")
    monkeypatch.setattr(choice, "_reported", set())


def test_fused_kernels_compute_plain_tensors_without_gradients():
    with kernels("fused"):
        assert choice.is_fused(ONE, None)
        assert not choice.is_fused(ONE, torch.ones(1, requires_grad=True))
        with torch.no_grad():
            assert choice.is_fused(torch.ones(1, requires_grad=True))
        assert not choice.is_fused(torch.ones(1, device="meta"))
    with kernels("torch"):
        assert not choice.is_fused(ONE)


def test_the_choice_ends_with_its_block():
    with kernels("torch"):
        with pytest.raises(RuntimeError, match="inside"), kernels("auto"):
            raise RuntimeError("inside")
        assert choice.chosen_kernels() == "torch"


def test_an_unknown_choice_lists_the_choices():
    with pytest.raises(InvalidArgumentError, match="kernels='numba' is not one of auto, fused, torch"):
        use_kernels("numba")


def test_the_environment_gives_the_default(monkeypatch):
    monkeypatch.setattr(choice, "_chosen", [])
    monkeypatch.setenv("GMMTORCH_KERNELS", "torch")
    assert choice.chosen_kernels() == "torch"
    monkeypatch.setattr(choice, "_chosen", [])
    monkeypatch.setenv("GMMTORCH_KERNELS", "cuda")
    with pytest.raises(InvalidArgumentError, match="GMMTORCH_KERNELS='cuda'"):
        choice.chosen_kernels()


@pytest.mark.usefixtures("no_compiler")
def test_fused_without_a_compiler_names_the_extra():
    with pytest.raises(GmmTorchError, match=r"warp-lang does not load .*gmmtorch\[fast\].*kernels=torch"):
        use_kernels("fused")


@pytest.mark.usefixtures("no_compiler")
def test_auto_without_a_compiler_logs_one_line(caplog):
    with caplog.at_level(logging.INFO, "gmmtorch"), kernels("auto"):
        assert not choice.is_fused(ONE)
        assert not choice.is_fused(ONE)
    assert [r.message for r in caplog.records] == [
        "Tensor operations replace fused kernels, because the package warp-lang does not load (test)."
    ]


def test_kernels_are_cached_in_the_first_folder_that_can_be_written(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(file))  # no folder can be made in a file
    temporary = compiler._cache_folder(None)
    assert temporary.is_dir()
    assert temporary.name.startswith("gmmtorch-kernels-")
    assert compiler._cache_folder(tmp_path / "own") == tmp_path / "own"


@pytest.mark.parametrize("n_threads", [1, 2])
def test_items_split_over_threads_are_each_run_once(n_threads):
    from gmmtorch.kernels.rays.ray_traversal import traverse

    starts = torch.rand(5000, 3, dtype=torch.float64) * 20

    def found() -> torch.Tensor:
        visits = traverse(starts, starts.flip(0), (20, 20, 20))
        return torch.cat([ray * 8000 + voxel for voxel, ray in visits]).sort().values

    with kernels("torch"):
        expected = found()
    torch.set_num_threads(n_threads)
    with kernels("fused"):
        assert torch.equal(found(), expected)


@pytest.mark.slow
def test_two_processes_compile_at_once_after_a_third_was_killed_while_it_compiled(tmp_path):
    code = "from gmmtorch.kernels import use_kernels; use_kernels('fused')"
    command, environment = [sys.executable, "-c", code], {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    killed = subprocess.Popen(command, env=environment)
    while killed.poll() is None and not any(path.is_file() for path in tmp_path.rglob("*")):
        time.sleep(0.01)
    killed.kill()
    assert killed.wait() != 0
    assert not list(tmp_path.rglob("*.o"))
    jobs = [subprocess.Popen(command, env=environment) for _ in range(2)]
    assert [job.wait() for job in jobs] == [0, 0]
    assert list(tmp_path.rglob("*.o"))


@pytest.mark.slow
def test_only_kernels_that_run_are_compiled_and_one_line_says_so(tmp_path):
    code = """import logging, torch
from gmmtorch.kernels.mixtures.cell_sums import distinct_keys
logging.basicConfig(level=logging.INFO)
from gmmtorch.kernels import use_kernels
use_kernels("fused")
distinct_keys(torch.arange(5))"""
    command, environment = [sys.executable, "-c", code], {**os.environ, "XDG_CACHE_HOME": str(tmp_path)}
    options = {"env": environment, "capture_output": True, "text": True, "check": True}
    first, second = (subprocess.run(command, **options) for _ in range(2))
    assert first.stderr.count("Compiling fused kernels") == 1
    assert "Compiling" not in second.stderr
    compiled = sorted(path.parent.name.rsplit("_", 1)[0] for path in tmp_path.rglob("*.o"))
    assert compiled == ["wp_gmmtorch_distinct_keys", "wp_gmmtorch_probe"]


def test_a_tensor_that_is_not_contiguous_is_refused_where_a_kernel_writes():
    turned = torch.ones(2, 3).T
    with pytest.raises(GmmTorchError, match=r"value of kernel probe has shape \(3, 2\).*contiguous"):
        compiler.FusedKernel("probe.h", "probe")(2, turned)
    assert compiler.FusedKernel("probe.h", "probe")._values((None,)) == ([0], [])


def test_a_forked_process_makes_its_own_threads():
    assert compiler._threads(2).submit(lambda: 1).result() == 1
    child = os.fork()
    if child == 0:
        os._exit(compiler._threads.cache_info().currsize)
    assert os.waitpid(child, 0)[1] == 0


def test_a_driver_that_is_too_old_gives_tensor_operations_and_one_line_of_log(monkeypatch, caplog):
    probe = compiler._PROBE

    def refused(n_items, value):
        if value.device.type != "cpu":
            raise RuntimeError("CUDA driver version is insufficient")
        probe(n_items, value)

    monkeypatch.setattr(choice, "_reported", set())
    monkeypatch.setattr(compiler, "_PROBE", refused)
    monkeypatch.setattr(compiler, "compiler_failure", compiler.compiler_failure.__wrapped__)
    made = torch.zeros
    names = {"cpu": "cpu", "cuda": "meta"}  # no GPU is needed
    monkeypatch.setattr(
        torch, "zeros", lambda *size, device, **rest: made(*size, device=names[device.type], **rest)
    )
    caplog.set_level(logging.INFO)
    assert not choice._compiler_works(torch.device("cuda", 0))
    assert not choice._compiler_works(torch.device("cuda", 0))
    assert [record.message for record in caplog.records if "driver version" in record.message] == [
        "Tensor operations replace fused kernels, because no kernel runs on cuda:0 "
        "(CUDA driver version is insufficient)."
    ]
    assert choice._compiler_works(torch.device("cpu"))
