"""Damaged copies of files of every format are read, or refused, within 1 GiB and a limit of time."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import damaged_files
import pytest


def failures(folder: Path, count: int, names: list[str], seed: int = 0) -> str:
    """What `damaged_files.py` prints: a line for each wrong outcome, and "done" unless it crashed."""
    here = Path(__file__).parent
    path = os.pathsep.join(map(str, (here.parents[1], here.parent, here)))
    command = [sys.executable, str(here / "damaged_files.py"), str(folder), str(seed), str(count), *names]
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True)
    lines = [line for line in done.stdout.splitlines() if line.startswith(("{", "done"))]
    assert "done" in lines, f"a crash at {sorted(folder.glob('last-*'))[-1:]}: {done.stderr[-2000:]}"
    return "\n".join(lines[:-1])


@pytest.mark.slow
def test_damaged_files_of_every_format_are_read_or_refused(tmp_path):
    names = [*damaged_files.FORMATS, *damaged_files.RECORDINGS, *damaged_files.WITH_OPEN3D]
    assert failures(tmp_path, 50, names) == ""


def test_damaged_headers_are_read_or_refused(tmp_path):
    names = [*damaged_files.FORMATS, *damaged_files.RECORDINGS]
    assert not list(damaged_files.wrong_outcomes(tmp_path, 2, 3, names, limited=False))


def test_the_limits_are_noticed(tmp_path, monkeypatch):
    """A reader that runs on, or asks for too much, is a failure."""
    monkeypatch.setattr(damaged_files, "CPU_SECONDS", 0.01)
    damaged_files.signal.signal(damaged_files.signal.SIGVTALRM, damaged_files.out_of_time)

    def runs_on(folder: Path) -> list:
        while True:
            pass

    def asks(folder: Path) -> list:
        raise MemoryError

    assert "TimeoutError" in (damaged_files.outcome(runs_on, tmp_path) or "")
    assert "MemoryError" in (damaged_files.outcome(asks, tmp_path) or "")
    assert damaged_files.outcome(lambda folder: [], tmp_path) is None
