"""The command gmmtorch-robot, run in this process."""

from __future__ import annotations

from pathlib import Path

import pytest
from cli.command_runs import QUIET, Finished, run_here
from cli.robot.robot_cases import Run

from gmmtorch.team.sharing.transport.security import KEY_VARIABLE


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a robot in this process, at a free address, without figures unless told otherwise."""
    monkeypatch.delenv(KEY_VARIABLE, raising=False)
    monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path / "cache"))

    def run_command(*options: str, name: str = "run") -> Finished:
        chosen = {option.split("=")[0] for option in options}
        defaults = [*QUIET, "link.listen=127.0.0.1:0", "team.size=1"]
        kept = [option for option in defaults if option.split("=")[0] not in chosen]
        return run_here(monkeypatch, "robot", tmp_path / name, *kept, *options)

    return run_command
