"""The scripts in examples/ and the Python blocks of README and docs run as they stand, in a new folder."""

from __future__ import annotations

import os
import re
import secrets
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
PYTHON_BLOCK = re.compile(r"^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)
PAGES = [
    path for path in sorted((ROOT / "docs").glob("*.md")) if PYTHON_BLOCK.search(path.read_text("utf-8"))
]


def test_there_are_examples():
    assert len(EXAMPLES) >= 6


@pytest.mark.slow
@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_example_runs(path, tmp_path):
    search = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [sys.executable, str(path)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": search, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip()


@pytest.mark.slow
def test_the_snippet_of_the_readme_prints_what_it_says(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
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
@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)
def test_the_python_blocks_of_a_page_run_in_order(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    key = tmp_path / "team.key"  # a shell block of docs/network.md makes one
    key.touch(0o600)
    key.write_text(secrets.token_hex(32))
    text = page.read_text(encoding="utf-8")
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in PYTHON_BLOCK.finditer(text):
        above = text[: block.start(1)].count("\n")  # so that a traceback names the line of the page
        exec(compile("\n" * above + block[1], str(page), "exec"), names)
