"""view=true: a browser sees the map while each command builds it, and a browser that leaves stops nothing."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from command_runs import QUIET, Finished, refused, room_mesh, run_here, succeeded

from gmmtorch.cli import map as map_command
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.team.cli import explore, robot, team

pytest.importorskip("viser")

from live.viser_client import Client, wait_until

from gmmtorch.live.live_view import LiveView, Moment

LOG = ["source=log", "dataset@log.dataset=synthetic_building_2d", "log.dataset.n_scans=4", "sensor.rate=20"]
LOG += ["log.map={window: 2}", "settle=0.2", "team.size=2"]


class Watched:
    """The views of commands, with two clients each: one stays, and one leaves after the first picture."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.moments: list[Moment] = []
        self.clients: list[Client] = []
        offer, draw = LiveView.offer, LiveView._draw

        def with_clients(view: LiveView, take: Callable[[], Moment]) -> None:
            if not self.clients:
                self.clients = [Client(view.url), Client(view.url)]
                wait_until(lambda: view.viewer.n_viewers == 2)
            if len(self.moments) == 1:
                self.clients[1].cut()
            view._next = 0.0  # draw as often as possible
            offer(view, take)
            wait_until(lambda: not view._is_busy)

        def noted(view: LiveView, moment: Moment) -> None:
            draw(view, moment)
            self.moments.append(moment)

        monkeypatch.setattr(LiveView, "offer", with_clients)
        monkeypatch.setattr(LiveView, "_draw", noted)
        for command in (map_command, explore, robot, team):
            monkeypatch.setattr(command, "serve", self._serve)

    def _serve(self, view: LiveView) -> None:
        self.clients[0].received(b"/components", b"/paths/0")
        view.stop()

    @property
    def sizes(self) -> list[int]:
        """Components of the moments that were drawn."""
        return [m.shown.n_components for m in self.moments if isinstance(m.shown, GaussianMap)]


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Watched:
    return Watched(monkeypatch)


@pytest.fixture
def in_room(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Callable[..., Finished]:
    """Runs a command of exploration in an empty room, for a few seconds."""
    monkeypatch.setenv("GMMTORCH_CACHE", str(tmp_path / "cache"))
    mesh = room_mesh(tmp_path / "room.obj")
    small = ["team.size=2", "sensor.width=48", "sensor.height=36", "duration=2", "evaluation.every=1"]

    def run(command: str, *options: str) -> Finished:
        room = ["world=mesh", f"world.path={mesh}"]
        return run_here(monkeypatch, command, tmp_path / "run", *QUIET, *small, *room, "view=true", *options)

    return run


def test_a_map_is_shown_while_it_is_built(watched, monkeypatch, tmp_path):
    options = ["dataset=synthetic_building_2d", "dataset.n_scans=5", "map.window=2", "view=true"]
    succeeded(run_here(monkeypatch, "map", tmp_path, *options, *QUIET))
    n_components = GaussianMap.load(tmp_path / "map.safetensors").n_components
    assert watched.sizes[-1] == n_components > watched.sizes[0] > 0
    assert len(watched.sizes) == 3  # after two windows, and with the last scan
    assert [len(m.robots[0].path) for m in watched.moments] == [2, 4, 5]
    assert watched.moments[-1].curves["components"]["components"][-1] <= n_components


@pytest.mark.parametrize("kind", ["gmm_shared", "grid_shared"])
def test_a_mission_is_shown_and_goes_on_as_without_a_view(kind, watched, in_room):
    shown = succeeded(in_room("explore", f"team={kind}", "port=8430"))
    assert "The map is at http://127.0.0.1:843" in shown.stdout
    (row,) = shown.results()["rows"]
    last = watched.moments[-1]
    assert len(watched.moments) >= 2
    assert [len(r.path) for r in last.robots] == [3, 3]
    assert [robot.number for robot in last.robots] == [0, 1]
    left = [100 * bits / row["observable_bits"] for bits in row["entropy_bits"]]
    assert list(last.curves["entropy left [%]"]["team"]) == pytest.approx(left)
    assert [1e3 * kb for kb in last.curves["sent [kB]"]["components"]] == row["bytes_over_time"]
    if kind == "gmm_shared":
        saved = GaussianMap.load(shown.folder / "map.safetensors")
        assert watched.sizes[-1] == saved.n_components
    else:
        assert len(last.shown.centres) > 100
    again = succeeded(in_room("explore", f"team={kind}", "view=false", f"hydra.run.dir={shown.folder}/2"))
    assert again.results()["rows"][0]["entropy_bits"] == row["entropy_bits"]


def test_a_study_has_no_view(watched, in_room):
    assert "view=true shows one mission" in refused(in_room("explore", "experiment=planners"))


def test_a_robot_shows_itself_and_its_map(watched, in_room):
    options = ["id=1", "settle=0.2", "speed=4", "link.listen=127.0.0.1:0", "link.peers=[127.0.0.1:9]"]
    succeeded(in_room("robot", *options))
    (shown,) = watched.moments[-1].robots
    assert shown.number == 1
    assert len(shown.path) == 3
    assert watched.sizes[-1] > 0
    assert watched.moments[-1].curves["sent [kB]"]["robot"][-1] > 0


def test_a_robot_that_replays_a_log_shows_where_its_components_were_seen(watched, monkeypatch, tmp_path):
    options = ["link.listen=127.0.0.1:0", "link.peers=[127.0.0.1:9]", "view=true"]
    done = succeeded(run_here(monkeypatch, "robot", tmp_path, *QUIET, *LOG, *options))
    assert watched.sizes[-1] == done.results()["rows"][0]["n_components"]
    (shown,) = watched.moments[-1].robots
    assert 1 <= len(shown.path) <= 4


def test_what_a_view_cannot_do_is_said_before_the_mission(watched, in_room, monkeypatch):
    assert "port=70000 must be at most 65535" in refused(in_room("explore", "port=70000"))
    assert "host=192.0.2.1 is not an address of this" in refused(in_room("robot", "host=192.0.2.1"))
    monkeypatch.setitem(sys.modules, "viser", None)
    for command in ("explore", "robot", "team"):
        assert "pip install 'gmmtorch[viewer]'" in refused(in_room(command))


@pytest.mark.slow
def test_a_team_is_shown_by_a_listener_in_its_network(watched, in_room):
    done = succeeded(in_room("team", "settle=3", "network.announce=0.5", "duration=3"))
    summary, *rows = done.results()["rows"]
    assert summary["same_map"] is True
    assert watched.sizes[-1] == rows[0]["n_components"]
    assert [robot.number for robot in watched.moments[-1].robots] == [0, 1]
    assert watched.moments[-1].curves["entropy left [%]"]["map"][-1] < 100


@pytest.mark.slow
def test_a_team_that_replays_a_log_is_shown(watched, monkeypatch, tmp_path):
    options = ["view=true", "settle=3", "network.announce=0.5"]
    kept = [option for option in LOG if not option.startswith("settle")]
    done = succeeded(run_here(monkeypatch, "team", tmp_path, *QUIET, *kept, *options))
    assert watched.sizes[-1] == done.results()["rows"][1]["n_components"]
    assert [robot.number for robot in watched.moments[-1].robots] == [0, 1]


def test_topics_are_shown_while_they_are_mapped(watched, monkeypatch, tmp_path, ros_domain):
    pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")
    from gmmtorch.live.ros import Node

    def publish() -> None:
        with Node("sensor", domain=ros_domain) as node:
            laser = node.publisher("/scan", "sensor_msgs/msg/LaserScan")
            scan: dict[str, Any] = {"angle_min": -1.5, "angle_increment": 0.05, "range_max": 9.0}
            while len(watched.moments) < 3:
                laser({**scan, "header": {"frame_id": "laser"}, "ranges": [2.0 + k / 50 for k in range(60)]})
                node.spin(seconds=0.05)
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=publish)
    thread.start()
    options = ["sensor.poses=standing", "map.window=2", "view=true"]
    done = succeeded(run_here(monkeypatch, "ros", tmp_path, *options, "wait=20", "report.progress=false"))
    thread.join()
    watched.clients[0].received(b"/components", b"/robots/0")
    assert min(watched.sizes[1:]) > 0
    assert done.results()["rows"][0]["n_scans"] >= 3
