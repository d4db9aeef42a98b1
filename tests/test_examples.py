"""The scripts in examples/ and the snippet of the README run as they are, in a folder of their own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted((ROOT / "examples").glob("*.py"))


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
