"""Without an optional package, what needs it says which extra to install; everything else is imported."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch

import gmmtorch as gt
from gmmtorch.errors import GmmTorchError

ROOT = Path(__file__).resolve().parents[1]
EXTRAS: dict[str, list[str]] = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
    "optional-dependencies"
]
IMPORTED = {
    "DracoPy": "DracoPy",
    "cryptography": "cryptography",
    "cyclonedds": "cyclonedds",
    "eclipse-zenoh": "zenoh",
    "kiss-icp": "kiss_icp",
    "laspy": "laspy",
    "pyoctomap": "pyoctomap",
    "ray": "ray",
    "rerun-sdk": "rerun",
    "rosbags": "rosbags",
    "viser": "viser",
    "warp-lang": "warp",
    "zstandard": "zstandard",
}
"""Import names of the optional packages that gmmtorch imports."""


def bag(folder: Path) -> object:
    from gmmtorch.export.bag import write_bag

    drive = gt.datasets.load("synthetic_building_2d", n_scans=1)
    return write_bag(folder / "a.mcap", [drive[0]], [drive.pose(0)])


def las(folder: Path) -> object:
    from gmmtorch.datasets.point_files.las_files import LasRows

    return LasRows(folder / "a.las")


def viewer(folder: Path) -> object:
    from gmmtorch.live.map_viewer import MapViewer

    return MapViewer(gt.GaussianMap())


def recording(folder: Path) -> object:
    from gmmtorch.team.report.mission_maps import load_rerun

    return load_rerun()


def codec(name: str) -> Callable[[Path], object]:
    from gmmtorch.team.sharing.point_codecs import bytes_of_points

    return lambda folder: bytes_of_points(torch.rand(50, 3), 0.1, 0.01, names=(name,))


def key(folder: Path) -> object:
    from gmmtorch.team.sharing.transport.security import TeamKey
    from gmmtorch.team.sharing.transport.udp import UdpTransport

    file = folder / "team.key"
    file.touch(0o600)
    file.write_text("ab" * 32)
    return UdpTransport.unicast(0, key=TeamKey.from_file(file))


def zenoh(folder: Path) -> object:
    from gmmtorch.team.sharing.transport.zenoh_transport import load_zenoh

    return load_zenoh()


def node(middleware: str) -> Callable[[Path], object]:
    def start(folder: Path) -> object:
        from gmmtorch.live.ros import Node

        return Node("a", middleware=middleware)

    return start


def odometry(folder: Path) -> object:
    from gmmtorch.localization.odometry import with_odometry

    return with_odometry(gt.datasets.load("synthetic_building_2d", n_scans=2), "kiss_icp")


def workers(folder: Path) -> object:
    from gmmtorch.optional_packages import load_ray

    return load_ray()


def fused(folder: Path) -> object:
    from gmmtorch.kernels import use_kernels

    return use_kernels("fused")


def octomap(folder: Path) -> object:
    tree = gt.baselines.OctoMapMap(0.1)
    tree.insert(gt.Scan([[1.0, 0.0, 0.0]], [0.0, 0.0, 0.0]))
    return tree


CASES = [
    ("rosbags", "bags", bag),
    ("laspy", "formats", las),
    ("viser", "viewer", viewer),
    ("rerun", "viewer", recording),
    ("pyoctomap", "baselines", octomap),
    ("DracoPy", "baselines", codec("draco")),
    ("zstandard", "baselines", codec("octree")),
    ("cryptography", "network", key),
    ("zenoh", "zenoh", zenoh),
    ("cyclonedds", "ros", node("dds")),
    ("zenoh", "ros", node("zenoh")),
    ("rosbags", "ros", node("dds")),
    ("kiss_icp", "odometry", odometry),
    ("ray", "cluster", workers),
    ("warp", "fast", fused),
]


@pytest.mark.parametrize(("package", "extra", "call"), CASES, ids=[f"{case[1]}-{case[0]}" for case in CASES])
def test_a_missing_package_names_its_extra(package, extra, call, tmp_path, monkeypatch):
    for name in [package, *(name for name in sys.modules if name.startswith(f"{package}."))]:
        monkeypatch.setitem(sys.modules, name, None)
    if package == "warp":
        from gmmtorch.kernels import compiler

        for cached in ("compiler_failure", "_warp"):  # what an earlier test has found
            monkeypatch.setattr(compiler, cached, getattr(compiler, cached).__wrapped__)
        monkeypatch.setattr(compiler._PROBE, "_loaded", set())
    with pytest.raises(GmmTorchError, match=re.escape(f"pip install 'gmmtorch[{extra}]'")):
        call(tmp_path)


def test_extras_have_the_packages_that_the_messages_name():
    named = set()
    for path in (ROOT / "gmmtorch").rglob("*.py"):
        text = path.read_text("utf-8")
        for part in ast.walk(ast.parse(text)) if "needs_extra(" in text else ():
            if isinstance(part, ast.Call) and getattr(part.func, "id", None) == "needs_extra":
                package, extra = part.args[1:]
                named |= {(package.value, extra.value)} if isinstance(package, ast.Constant) else set()
    assert len(named) >= 10
    for package, extra in named:
        assert any(re.match(rf"{package}\b", requirement) for requirement in EXTRAS[extra]), (package, extra)


@pytest.mark.slow
def test_every_module_is_imported_without_any_optional_package():
    program = f"""
import importlib, pkgutil, sys
for name in {sorted(IMPORTED.values())}:
    sys.modules[name] = None
import gmmtorch
for module in pkgutil.walk_packages(gmmtorch.__path__, "gmmtorch."):
    importlib.import_module(module.name)
"""
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
