"""scripts/fuzz.py finds no fault in a short run, and finds one that is there."""

from __future__ import annotations

import runpy
import subprocess
import sys
from pathlib import Path

import pytest

FUZZ = Path(__file__).resolve().parents[1] / "scripts" / "fuzz.py"

TARGETS = "trajectory,png,pcd,metadata,map behind,tiles,frames,stores,udp"


@pytest.mark.slow
def test_a_short_run_finds_nothing(tmp_path):
    options = ["--inputs", "400", "--targets", TARGETS, "--folder", str(tmp_path)]
    done = subprocess.run([sys.executable, FUZZ, *options], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_faults_are_found_and_their_inputs_kept(tmp_path):
    script = runpy.run_path(str(FUZZ))

    def read(path: Path) -> None:
        raise KeyError(path.name)

    outcomes = list(script["batch"](script["Target"]({"a.txt": b"sound"}, read), 0, 5, tmp_path))
    assert len(outcomes) == 5
    assert all(outcome.startswith("fault: KeyError") for outcome in outcomes)
    assert list(tmp_path.glob("fault-*-a.txt"))
