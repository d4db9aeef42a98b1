"""The C++ sources of the kernels: each compiles alone, and the launches match them."""

from __future__ import annotations

import importlib
import pkgutil
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from scipy.special import erfcx

import gmmtorch.kernels
from gmmtorch.errors import GmmTorchError
from gmmtorch.kernels import compiler
from gmmtorch.kernels.compiler import CPU_LANES, FusedKernel
from gmmtorch.kernels.evidence import point_evidence
from gmmtorch.kernels.mixtures import cell_sums, em_loops, pair_merges
from gmmtorch.kernels.rays import beam_information

pytestmark = pytest.mark.cpu_only

FOLDER = Path(gmmtorch.kernels.__file__).parent
SOURCES = sorted(FOLDER.rglob("*.h"))
MODULES = [
    importlib.import_module(found.name)
    for found in pkgutil.walk_packages(gmmtorch.kernels.__path__, "gmmtorch.kernels.")
]


def all_kernels() -> list[FusedKernel]:
    named = [value for module in MODULES for value in vars(module).values()]
    listed = [item for value in named for item in (value.values() if isinstance(value, dict) else [value])]
    return [item for item in listed if isinstance(item, FusedKernel)]


def kernel_of(folder: Path, body: str, *includes: Path) -> FusedKernel:
    """A kernel `computed(double* x)` with this body, in a source of its own."""
    source = folder / "computed.h"
    included = "".join(f'#include "{path}"\n' for path in includes)
    source.write_text(
        f"{included}namespace gmm {{\nGMM_KERNEL computed(int64_t item, double* x) {{ {body} }}\n}}\n"
    )
    return FusedKernel(str(source), "computed")


@pytest.mark.skipif(sys.platform != "linux" or not shutil.which("c++"), reason="needs a C++ compiler")
@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_each_source_compiles_alone_without_a_warning(source):
    command = ["c++", "-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Werror", "-x", "c++", "-"]
    done = subprocess.run(
        command, input=f'#include "{source}"\n', text=True, capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("source", SOURCES, ids=lambda source: source.stem)
def test_each_source_compiles_alone_for_the_vectors_of_a_cpu(source, tmp_path):
    kernel_of(tmp_path, "x[item] = 1.0;", source).load(torch.device("cpu"))


@pytest.mark.slow
def test_the_cuda_source_of_every_kernel_compiles_without_a_gpu(tmp_path):
    warp = pytest.importorskip("warp")
    assert compiler.compiler_failure() is None  # this sets warp up
    assert len(all_kernels()) > 50
    for kernel in all_kernels():
        folder = tmp_path / kernel.name
        warp.compile_aot_module(kernel.defined("cuda").module, arch=80, module_dir=str(folder), use_ptx=True)
        assert list(folder.glob("*.ptx")), kernel.name


def test_every_kernel_of_a_source_is_launched_under_a_name_of_its_own():
    written = [re.findall(r"GMM_KERNEL (\w+)\(", source.read_text()) for source in SOURCES]
    launched = {kernel._call.partition("<")[0] for kernel in all_kernels()}
    assert sorted(name for names in written for name in names) == sorted(launched)
    assert len({kernel.name for kernel in all_kernels()}) == len(set(map(id, all_kernels())))


def test_constants_of_the_sources_are_those_of_the_modules(tmp_path):
    names = ["LANES", "BLOCK", "KEY_BITS", "REACH", "PATCH", "REACHED", "WORTHLESS", "IMAGE_ODDS"]
    names += ["MERGED", "SELECTION_COUNTS", "GROUP"]
    body = " ".join(f"x[{place}] = {name};" for place, name in enumerate(names))
    found = torch.zeros(len(names)).double()
    sources = FOLDER / "mixtures/depth_cells.h", FOLDER / "rays/beam_information.h"
    sources += FOLDER / "mixtures/em_loops.h", FOLDER / "selection.h", FOLDER / "evidence/point_evidence.h"
    kernel_of(tmp_path, body, *sources)(1, found)
    modules = [compiler, compiler, *[cell_sums] * 3, *[beam_information] * 3, em_loops, pair_merges]
    modules.append(point_evidence)
    values = [
        getattr(module, {"LANES": "CPU_LANES", "BLOCK": "_BLOCK"}.get(name, name))
        for module, name in zip(modules, names, strict=True)
    ]
    torch.testing.assert_close(found, torch.tensor(values).double(), rtol=1e-7, atol=0)  # one is a float32


@pytest.mark.parametrize("dim", [1, 2, 3])
@pytest.mark.parametrize("kind", ["any", "needles", "equal", "diagonal", "zero"])
def test_axes_of_a_matrix_are_those_of_the_library(dim, kind, tmp_path):
    roots = torch.randn(200, dim, dim, generator=torch.Generator().manual_seed(dim)).double()
    scale = {"any": 1.0, "needles": torch.logspace(-6, 3, dim), "diagonal": 0.0, "zero": 0.0}.get(kind, 1e-3)
    given = roots * scale @ (roots * scale).mT + (
        torch.eye(dim).double() if kind in ("equal", "diagonal") else 0
    )
    found = torch.cat([given, torch.zeros_like(given)], 1).contiguous()
    body = f"diagonalize<{dim}>(*(double (*)[{dim}][{dim}])(x + {2 * dim * dim} * item), "
    body += f"*(double (*)[{dim}][{dim}])(x + {2 * dim * dim} * item + {dim * dim}));"
    kernel_of(tmp_path, body, FOLDER / "jacobi.h")(200, found)
    values, axes = found[:, :dim].diagonal(dim1=1, dim2=2), found[:, dim:]
    size = float(given.abs().max()) or 1.0
    torch.testing.assert_close(
        values.sort(1).values, torch.linalg.eigvalsh(given), rtol=1e-12, atol=1e-14 * size
    )
    torch.testing.assert_close(
        axes @ torch.diag_embed(values) @ axes.mT, given, rtol=1e-12, atol=1e-14 * size
    )
    torch.testing.assert_close(axes @ axes.mT, torch.eye(dim).double().expand_as(given), rtol=0, atol=1e-13)


def test_the_mills_ratio_equals_the_error_function(tmp_path):
    x = torch.cat([torch.linspace(0, 12, 2001), torch.logspace(1, 5, 199)]).double()
    found = x.clone()
    body = "vec& v = ((vec*)x)[item]; v = mills(v);"
    kernel_of(tmp_path, body, FOLDER / "lanes.h")(len(x) // CPU_LANES, found)
    exact = torch.from_numpy((torch.pi / 2) ** 0.5 * erfcx((x / 2**0.5).numpy()))
    assert float((found / exact - 1).abs().max()) < 2e-14


def test_the_angle_of_a_place_equals_the_library_function(tmp_path):
    draw = torch.Generator().manual_seed(0)
    places = torch.randn(4000, 2, generator=draw).double() * 10 ** (6 * torch.randn(4000, 1, generator=draw))
    places[:8] = torch.tensor([[0, 0], [1, 0], [0, 1], [-1, 0], [0, -1], [1, 1], [-2, 2], [-3, -3]]).double()
    found = places.clone().T.contiguous()
    body = f"vec& y = ((vec*)x)[item]; y = arctangent(y, ((vec*)x)[item + {4000 // CPU_LANES}]);"
    kernel_of(tmp_path, body, FOLDER / "lanes.h")(4000 // CPU_LANES, found)
    torch.testing.assert_close(found[0], torch.atan2(places[:, 0], places[:, 1]), rtol=4e-16, atol=1e-300)


def test_a_kernel_is_compiled_again_when_a_file_that_it_includes_changes(tmp_path):
    (tmp_path / "one.h").write_text(f'#include "{FOLDER / "device.h"}"\nconstexpr double NUMBER = 1.0;\n')
    for number in (1.0, 2.0):
        (tmp_path / "one.h").write_text((tmp_path / "one.h").read_text().replace("1.0", str(number)))
        found = torch.zeros(1).double()
        kernel_of(tmp_path, "x[item] = NUMBER;", tmp_path / "one.h")(1, found)
        assert float(found) == number


def test_errors_of_sources_name_the_kernel(tmp_path):
    with pytest.raises(ValueError, match=r"lanes.h has no kernel mills"):
        FusedKernel("lanes.h", "mills").load(torch.device("cpu"))
    with pytest.raises(GmmTorchError, match="kernel computed does not compile for cpu"):
        kernel_of(tmp_path, "x[item] = nothing;", FOLDER / "device.h").load(torch.device("cpu"))
