"""The scripts in examples/, the Python blocks of README and docs, and the tutorials run as they stand.

They run in a new folder, but in the process of the test: a new one spends most of its time importing torch.
"""

from __future__ import annotations

import re
import runpy
import secrets
import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import pytest

from gmmtorch.datasets import synthetic

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
BLOCK = re.compile(r"^```(?:python|\{code-cell\})\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = [path for path in sorted((ROOT / "docs").rglob("*.md")) if BLOCK.search(path.read_text("utf-8"))]


@pytest.fixture(scope="module", autouse=True)
def _equal_scans_are_simulated_once():
    """Nearly every page reads the scans of an embedded building."""
    sense, made = synthetic.sense, {}

    def once(sensor, pose, world, generator):
        key = type(world), len(sensor.directions), tuple(pose.flatten().tolist()), generator.initial_seed()
        if key not in made:
            made[key] = sense(sensor, pose, world, generator)
        return tuple(part.clone() for part in made[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(synthetic, "sense", once)
        yield


@pytest.fixture(autouse=True)
def _a_new_folder_without_a_screen(tmp_path, monkeypatch):
    plt.switch_backend("agg")
    monkeypatch.chdir(tmp_path)
    yield
    plt.close("all")


def test_there_are_examples_and_tutorials():
    assert len(EXAMPLES) >= 6
    assert sum(page.parent.name == "tutorials" for page in PAGES) == 8


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out.strip()


@pytest.mark.slow
def test_the_snippet_of_the_readme_prints_what_it_says(tmp_path):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (snippet,) = re.findall(r"```python\n(import gmmtorch.*?)```", text, re.DOTALL)
    (said,) = re.findall(r"# median ([\d.]+) on these surface points", snippet)
    names: dict[str, Any] = {}
    exec(snippet, names)
    assert float(names["p"].median()) == pytest.approx(float(said), abs=0.006)
    assert float(said) > 0.8
    assert (tmp_path / "building.safetensors").stat().st_size <= 8000
    assert names["gmm"].means_.shape == (100, 3)


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch, request):
    text = page.read_text(encoding="utf-8")
    if "gmmtorch.live.ros" in text:
        monkeypatch.setenv("ROS_DOMAIN_ID", str(request.getfixturevalue("ros_domain")))
    key = tmp_path / "team.key"  # a shell block of docs/network.md makes one
    key.touch(0o600)
    key.write_text(secrets.token_hex(32))
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in BLOCK.finditer(text):
        above = text[: block.start(1)].count("\n")  # so that a traceback names the line of the page
        exec(compile("\n" * above + block[1], str(page), "exec"), names)
