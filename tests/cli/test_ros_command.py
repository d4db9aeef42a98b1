"""gmmtorch-ros: playing, mapping and errors."""

from __future__ import annotations

import os
import signal
import threading
import time

import pytest
from command_runs import refused, run_here, run_script, succeeded

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")
pytest.importorskip("cyclonedds", reason="needs the extra [ros]: cyclonedds")

from gmmtorch.export.bag import BagWriter
from gmmtorch.live.ros import Node
from gmmtorch.mapping.gaussian_map import GaussianMap

LASER = "sensor_msgs/msg/LaserScan"


def test_a_missing_topic_is_an_error_that_lists_what_is_there(monkeypatch, tmp_path, ros_domain):
    error = refused(run_here(monkeypatch, "ros", tmp_path, f"node.domain={ros_domain}", "wait=0.2"))
    assert "no topic of a range sensor after 0.2 s. Published topics: none" in error


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("node.middleware=tcp", "node.middleware='tcp'"),
        ("node.domain=500", "domain=500"),
        ("sensor.poses=gps", "sensor.poses='gps'"),
        ("play=nowhere.bag", "nowhere.bag"),
    ],
)
def test_wrong_options_are_errors_of_one_line(monkeypatch, tmp_path, ros_domain, option, words):
    options = [f"node.domain={ros_domain}"] if "domain" not in option else []
    assert words in refused(run_here(monkeypatch, "ros", tmp_path, *options, option, "wait=0.2"))


@pytest.mark.slow
def test_ctrl_c_saves_the_map_of_a_played_recording(monkeypatch, tmp_path, ros_domain):
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i in range(20):
            bag.laser("/scan", i / 10, "laser", [2.0 + k / 50 for k in range(60)], -1.5, 0.05, 9.0)

    def play_and_stop() -> None:
        options = [f"node.domain={ros_domain}", "rate=4", "wait=60", f"play={tmp_path / 'a.mcap'}"]
        played.append(run_script("ros", tmp_path / "play", *options, "report.progress=false"))
        end = time.monotonic() + 60
        while not any(count["received"] == 20 for count in counts()) and time.monotonic() < end:
            time.sleep(0.1)
        os.kill(os.getpid(), signal.SIGINT)

    nodes, played = [], []
    made = Node.__init__

    def remember(self: Node, *arguments: object, **options: object) -> None:
        made(self, *arguments, **options)
        nodes.append(self)

    def counts() -> list[dict[str, int]]:
        return [count for node in nodes for count in node.counts.values()]

    monkeypatch.setattr(Node, "__init__", remember)
    thread = threading.Thread(target=play_and_stop)
    thread.start()
    options = [f"node.domain={ros_domain}", "wait=60", "sensor.poses=standing", "sensor.max_latency=null"]
    done = succeeded(run_here(monkeypatch, "ros", tmp_path / "run", *options, "report.progress=false"))
    thread.join()
    assert "played    20 of 20 messages" in succeeded(played[0]).stdout
    (row,) = done.results()["rows"]
    assert (row["n_scans"], row["n_dropped"], row["n_malformed"]) == (20, 0, 0)
    assert GaussianMap.load(done.folder / "map.safetensors").n_components == row["n_components"]
    assert "trajectory.tum" in done.files()
    assert LASER in done.stdout
