"""Without an optional package, what needs it says which extra to install; everything else is imported."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

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


def of(name: str) -> Any:
    """An object of the package by its dotted name, imported when it is used."""
    module, _, last = name.rpartition(".")
    return getattr(importlib.import_module(f"gmmtorch.{module}"), last)


def drive() -> Any:
    return gt.datasets.load("synthetic_building_2d", n_scans=2)


def points_coded_by(name: str) -> Callable[[Path], object]:
    points = torch.rand(50, 3)
    return lambda folder: of("team.sharing.point_codecs.bytes_of_points")(points, 0.1, 0.01, names=(name,))


def key(folder: Path) -> object:
    (folder / "team.key").touch(0o600)
    (folder / "team.key").write_text("ab" * 32)
    found = of("team.sharing.transport.security.TeamKey").from_file(folder / "team.key")
    return of("team.sharing.transport.udp.UdpTransport").unicast(0, key=found)


def write_bag(folder: Path) -> object:
    return of("export.bag.write_bag")(folder / "a.mcap", [drive()[0]], [drive().pose(0)])


SCAN = gt.Scan([[1.0, 0.0, 0.0]], [0.0, 0.0, 0.0])
CASES: list[tuple[str, str, Callable[[Path], object]]] = [
    ("rosbags", "bags", write_bag),
    ("laspy", "formats", lambda folder: of("datasets.point_files.las_files.LasRows")(folder / "a.las")),
    ("viser", "viewer", lambda _: of("live.map_viewer.MapViewer")(gt.GaussianMap())),
    ("rerun", "viewer", lambda _: of("team.report.mission_maps.load_rerun")()),
    ("pyoctomap", "baselines", lambda _: gt.baselines.OctoMapMap(0.1).insert(SCAN)),
    ("DracoPy", "baselines", points_coded_by("draco")),
    ("zstandard", "baselines", points_coded_by("octree")),
    ("cryptography", "network", key),
    ("zenoh", "zenoh", lambda _: of("team.sharing.transport.zenoh_transport.load_zenoh")()),
    ("cyclonedds", "ros", lambda _: of("live.ros.Node")("a", middleware="dds")),
    ("zenoh", "ros", lambda _: of("live.ros.Node")("a", middleware="zenoh")),
    ("rosbags", "ros", lambda _: of("live.ros.Node")("a", middleware="dds")),
    ("kiss_icp", "odometry", lambda _: of("localization.odometry.with_odometry")(drive(), "kiss_icp")),
    ("ray", "cluster", lambda _: of("optional_packages.load_ray")()),
    ("warp", "fast", lambda _: of("kernels.use_kernels")("fused")),
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
