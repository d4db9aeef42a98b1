"""Worker processes end with their parent."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from gmmtorch.processes import end_with_parent, has_lost_parent

_WORK = """
work = "\\n".join([
    "from gmmtorch.processes import end_with_parent",
    "end_with_parent()",
    "print('at work', flush=True)",
    "while True: pass",
])
"""
_JOBLIB = (
    _WORK
    + """
from joblib import Parallel, delayed
Parallel(n_jobs=2)(delayed(exec)(work) for _ in range(2))
"""
)
_MULTIPROCESSING = (
    _WORK
    + """
import multiprocessing
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=exec, args=(work,)) for _ in range(2)]
    for process in processes: process.start()
    for process in processes: process.join()
"""
)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a pipe stays open as long as any process has it")
@pytest.mark.parametrize("program", [_JOBLIB, _MULTIPROCESSING], ids=["joblib", "multiprocessing"])
def test_workers_end_when_their_parent_is_killed(program: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", program], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == "at work\n"
        parent.kill()
        parent.communicate(timeout=60)  # ends once no process can write to the pipe


def test_end_with_parent_leaves_other_processes_alone() -> None:
    end_with_parent()


@pytest.mark.parametrize("platform", ["linux", "darwin"])
def test_a_process_has_lost_its_parent_if_another_has_adopted_it(platform, monkeypatch):
    monkeypatch.setattr(sys, "platform", platform)
    assert not has_lost_parent(str(os.getppid()))
    assert has_lost_parent(str(os.getpid()))


def test_a_launcher_between_two_processes_of_windows_is_no_lost_parent(monkeypatch):
    monkeypatch.setattr(sys, "platform", "win32")
    assert not has_lost_parent(str(os.getpid()))
