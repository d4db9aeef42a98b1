"""An empty room, and the command in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cli.command_runs import Finished, room_mesh, succeeded
from cli.explore.explore_cases import Run, run_in


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return room_mesh(tmp_path_factory.mktemp("mesh") / "room.obj")


@pytest.fixture(scope="module", autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A cache of worlds of their own."""
    with pytest.MonkeyPatch.context() as monkeypatch:
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
