"""gmmtorch-view: its arguments, the HTML file, and errors."""

from __future__ import annotations

import pytest
from command_runs import composed, refused, run_here, succeeded

from gmmtorch.cli import inputs
from gmmtorch.cli.view import overrides
from gmmtorch.datasets import load
from gmmtorch.mapping import GaussianMap, tile_files

pytest.importorskip("viser")


def test_files_become_options():
    assert overrides(["a b.safetensors", "--html", "it's.html", "port=9"]) == [
        "path='a b.safetensors'",
        "html='it\\'s.html'",
        "port=9",
    ]
    assert overrides(["--html=c.html", "--cfg", "job", "x"]) == ["html='c.html'", "--cfg", "job", "path='x'"]


def test_html_of_a_run_directory_and_errors(monkeypatch, tmp_path):
    built = GaussianMap()
    for scan in load("synthetic_building_2d", n_scans=2):
        built.insert(scan)
    built.save(tmp_path / "map.safetensors")
    (tmp_path / "trajectory.tum").write_text("0 1 2 0 0 0 0 1\n1 2 2 0 0 0 0 1\n")
    html = f"html={tmp_path / 'map.html'}"
    done = succeeded(run_here(monkeypatch, "view", tmp_path, f"path={tmp_path}", html))
    assert (tmp_path / "map.html").stat().st_size > 30_000
    assert "open it in a browser" in done.stdout
    assert "path is not set" in refused(run_here(monkeypatch, "view", tmp_path))
    (tmp_path / "trajectory.tum").write_text("no numbers\n")
    assert "'no' is not a number" in refused(
        run_here(monkeypatch, "view", tmp_path, f"path={tmp_path}", html)
    )


def test_html_of_a_part_of_a_map_in_tiles(monkeypatch, tmp_path):
    built = GaussianMap()
    for scan in load("synthetic_building_2d", n_scans=2):
        built.insert(scan)
    (tmp_path / "tiles").mkdir()
    for name, data in tile_files(built.components(), built.settings, 5.0).items():
        (tmp_path / "tiles" / name).write_bytes(data)
    html = f"html={tmp_path / 'map.html'}"
    succeeded(run_here(monkeypatch, "view", tmp_path, f"path={tmp_path}", html, "bounds=[2,10,3,11]"))
    assert (tmp_path / "map.html").stat().st_size > 10_000
    part = inputs.open_map(tmp_path, composed("view").runtime, [2, 10, 3, 11])
    assert 0 < part.n_components <= inputs.open_map(tmp_path, composed("view").runtime).n_components
