"""A mission of two robots in a room."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from cli.command_runs import QUIET, Finished, run_here

Run = Callable[..., Finished]
FIELDS = {
    "framework", "seed", "world", "n_robots", "duration", "times", "entropy_bits", "entropy_bits_per_robot",
    "observable_bits", "entropy_reduction_bits", "t50", "t90", "bytes_sent", "bytes_raw_points", "datagrams",
    "map_disagreement", "auc", "cross_entropy_bits", "collisions", "path_length", "coverage_per_metre",
    "overlap", "wall_seconds",
}  # fmt: skip


SMALL = ["team.size=2", "sensor.width=48", "sensor.height=36", "workers=1"]


def run_in(monkeypatch: pytest.MonkeyPatch, folder: Path, room: Path, *options: str) -> Finished:
    """Two robots in the room for two seconds, without figures unless told otherwise."""
    defaults = [*QUIET, *SMALL, "world=mesh", f"world.path={room}", "duration=2", "evaluation.every=2"]
    chosen = {option.split("=")[0] for option in options}  # Hydra accepts a group only once
    kept = [option for option in defaults if option.split("=")[0] not in chosen]
    return run_here(monkeypatch, "explore", folder, *kept, *options)
