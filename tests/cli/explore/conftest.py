"""An empty room, and the command in it."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.command_runs import (
    COMMANDS,
    Finished,
    succeeded,
)
from cli.explore.explore_cases import ROOM, Run, run_in

from gmmtorch.cli import explore, export


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A mesh: the six walls of an empty room, two triangles each."""
    path = tmp_path_factory.mktemp("mesh") / "room.obj"
    corners = [f"v {x} {y} {z}" for x, y, z in itertools.product(*((0.0, side) for side in ROOM))]
    walls = [(1, 2, 4, 3), (5, 7, 8, 6), (1, 5, 6, 2), (3, 4, 8, 7), (1, 3, 7, 5), (2, 6, 8, 4)]
    faces = [f"f {a} {b} {c}\nf {a} {c} {d}" for a, b, c, d in walls]
    path.write_text("\n".join([*corners, *faces, ""]))
    return path


@pytest.fixture(scope="module", autouse=True)
def with_these_commands(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """The commands of this file, with a cache of worlds of their own."""
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setitem(COMMANDS, "explore", explore)
        monkeypatch.setitem(COMMANDS, "export", export)
        monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, room: Path) -> Run:
    def run_command(*options: str, name: str = "run") -> Finished:
        return run_in(monkeypatch, tmp_path / name, room, *options)

    return run_command


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory, room: Path) -> Iterator[Finished]:
    """Nine seconds in the room, with everything that the command writes."""
    shown = [f"report.{name}=true" for name in ("progress", "figures", "tensorboard")]
    with pytest.MonkeyPatch.context() as monkeypatch:
        folder = tmp_path_factory.mktemp("explore") / "run"
        yield succeeded(run_in(monkeypatch, folder, room, "duration=9", *shown))


@pytest.fixture(scope="module")
def row(mission: Finished) -> dict[str, Any]:
    (only,) = mission.results()["rows"]
    return dict(only)
