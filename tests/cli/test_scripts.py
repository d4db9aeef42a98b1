"""The commands as scripts of a checkout."""

from __future__ import annotations

import os
import runpy
import sys

import pytest
from command_runs import CHECKOUT

SCRIPTS = sorted((CHECKOUT / "scripts").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_processes_of_a_study_import_the_script_without_running_it(script, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    names = runpy.run_path(str(script), run_name="__mp_main__")
    assert callable(names["main"])


def test_there_is_a_script_for_every_command():
    assert {"fit", "occupancy", "explore", "export", "robot", "team"} <= {script.stem for script in SCRIPTS}


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.stem)
def test_a_script_runs_by_its_name(script):
    assert script.read_text(encoding="utf-8").startswith("#!")
    assert os.access(script, os.X_OK)
