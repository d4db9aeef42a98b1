"""gmmtorch-ros: playing, mapping and errors."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np
import pytest
import torch
from command_runs import CHECKOUT, composed, environment, refused, run_here, run_script, succeeded

pytest.importorskip("rosbags", reason="needs the extra [ros]: rosbags")

from exploration.replays import content
from mapping.random_components import random_components
from sensor_bags import BagWriter

from gmmtorch.datasets import Ranges, Sensor, Topic, TransformTree
from gmmtorch.datasets.ros.bag_topics import LASER as LASERS
from gmmtorch.live.live_scans import LiveOptions, LiveScans
from gmmtorch.live.ros import Node
from gmmtorch.mapping import GaussianMap, MapBuilder
from gmmtorch.team.cli import from_options
from gmmtorch.team.sharing import Replica, SharedMap, UdpTransport

LASER = "sensor_msgs/msg/LaserScan"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

needs_dds = pytest.mark.skipif(
    importlib.util.find_spec("cyclonedds") is None, reason="needs the extra [ros]: cyclonedds"
)


def of_node(options: dict[str, Any]) -> list[str]:
    return [f"node.{name}={value}" for name, value in options.items() if name != "domain"]


def test_a_missing_topic_is_an_error_that_lists_what_is_there(monkeypatch, tmp_path, ros_options):
    error = refused(run_here(monkeypatch, "ros", tmp_path, *of_node(ros_options), "wait=0.2"))
    assert "no topic of a range sensor after 0.2 s. Published topics: none" in error


@needs_dds
@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("node.middleware=tcp", "node.middleware='tcp'"),
        ("sensor.poses=gps", "sensor.poses='gps'"),
        ("play=nowhere.bag", "nowhere.bag"),
        ("transport=tcp", "transport='tcp' is not one of udp, zenoh"),
        ("start=lost", "start='lost'"),
        ("id=-1", "id=-1"),
        ("settle=-1", "settle=-1"),
        ("network.budget=0 transport=udp link.listen=127.0.0.1:0", "network.budget=0"),
    ],
)
def test_wrong_options_are_errors_of_one_line(monkeypatch, tmp_path, ros_domain, option, words):
    assert words in refused(run_here(monkeypatch, "ros", tmp_path, *option.split(), "wait=0.2"))


@pytest.mark.parametrize("dim", [2, 3])
def test_a_robot_that_starts_again_keeps_its_frame(monkeypatch, tmp_path, dim):
    monkeypatch.setattr(from_options, "run_dir", lambda: tmp_path)
    config = composed("ros", "transport=udp", "start=unknown", "link.listen=127.0.0.1:0")
    made = [random_components(dim, k=3, seed=seed) for seed in range(2)]
    for number, components in enumerate(made):
        with ExitStack() as stack:
            shared = from_options.shared_map(config, stack)
            assert shared is not None
            shared.replica.add(components)
            shared.exchange(0.0)
            assert len(shared.components()) == 3 * (number + 1)


@pytest.mark.slow
def test_ctrl_c_saves_the_map_of_a_played_recording(monkeypatch, tmp_path, ros_options):
    on_network = of_node(ros_options)
    with BagWriter(tmp_path / "a.mcap") as bag:
        for i in range(20):
            bag.laser("/scan", i / 10, "laser", [2.0 + k / 50 for k in range(60)], -1.5, 0.05, 9.0)

    def play_and_stop() -> None:
        options = [*on_network, "speed=4", "wait=60", f"play={tmp_path / 'a.mcap'}"]
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
    options = [*on_network, "wait=60", "sensor.poses=standing", "sensor.max_latency=null"]
    done = succeeded(run_here(monkeypatch, "ros", tmp_path / "run", *options, "report.progress=false"))
    thread.join()
    assert "played    20 of 20 messages" in succeeded(played[0]).stdout
    (row,) = done.results()["rows"]
    assert (row["n_scans"], row["n_dropped"], row["n_malformed"]) == (20, 0, 0)
    assert GaussianMap.load(done.folder / "map.safetensors").n_components == row["n_components"]
    assert "trajectory.tum" in done.files()
    assert LASER in done.stdout


def until(is_done: Callable[[], bool], what: str, seconds: float = 50.0) -> None:
    end = time.monotonic() + seconds
    while not is_done():
        assert time.monotonic() < end, f"{what} did not happen"
        time.sleep(0.05)


def sweep(index: int) -> dict[str, Any]:
    """A laser scan of a room whose walls seem to move."""
    ranges = (2.0 + np.arange(60) / 50 + index / 100).astype(np.float32)
    stamp = {"sec": 100 + index // 10, "nanosec": index % 10 * 100_000_000}
    angles = {"angle_min": -1.5, "angle_increment": 0.05, "time_increment": 0.0}
    about = {**angles, "range_min": 0.0, "range_max": 9.0, "ranges": ranges}
    return {"header": {"frame_id": "laser", "stamp": stamp}, **about}


def n_scans(message: dict[str, Any]) -> int:
    (values,) = [status["values"] for status in message["status"]]
    return next(int(pair["value"]) for pair in values if pair["key"] == "n_scans")


def mapped(sweeps: list[int]) -> GaussianMap:
    """The map of these sweeps without a network."""
    sensor, options = Sensor(Topic("/scan", LASER, 0), LASERS), LiveOptions(poses="standing")
    scans = LiveScans(sensor, TransformTree(), Ranges(), options)
    builder = MapBuilder(scans, GaussianMap())
    for index in sweeps:
        scans.receive(sweep(index), 0)
        assert scans.advance()
        list(builder.insert_all())
    builder.finish()
    return builder.map


@needs_dds
@pytest.mark.slow
def test_a_killed_mapper_of_a_team_goes_on_after_its_last_checkpoint(tmp_path, ros_domain):
    folder, (here, other) = tmp_path / "run", from_options.free_addresses(2)
    options = [
        f"hydra.run.dir={folder}",
        "wait=50",
        "sensor.poses=standing",
        "sensor.max_latency=null",
        "checkpoint_seconds=0",
        "report.progress=false",
        "transport=udp",
        f"link.listen={here}",
        f"link.peers=[{other}]",
    ]

    def mapper() -> subprocess.Popen[str]:
        arguments = [sys.executable, str(CHECKOUT / "scripts" / "ros.py"), *options]
        made = subprocess.Popen(arguments, env=environment(), stdout=subprocess.PIPE, text=True)
        until(lambda: any(end.topic == "/scan" for end in sensor.subscribers()), "a subscription")
        time.sleep(1.0)
        return made

    transport = UdpTransport.unicast(1, from_options.address("", other), [from_options.address("", here)])
    teammate = SharedMap(Replica(1), transport)
    seen = mapped([99]).components()
    teammate.replica.publish(seen, whole=True)
    with Node("sensor", domain=ros_domain) as sensor:
        send = sensor.publisher("/scan", LASER)
        first = mapper()
        for index in range(60):
            send(sweep(index))
            time.sleep(0.02)
            if index > 30 and (folder / "checkpoint.safetensors").exists():
                break
        first.kill()
        first.wait()
        until(lambda: not any(end.topic == "/scan" for end in sensor.subscribers()), "the end of the first")
        second = mapper()
        assert second.stdout is not None
        line = next(line for line in second.stdout if line.startswith("continues after scan "))
        n_before, counts = int(line.split()[3]), [0]
        sensor.subscribe("/diagnostics", DIAGNOSTICS, lambda message: counts.append(n_scans(message)))
        later = list(range(70, 90))
        for index in later:
            send(sweep(index))
            time.sleep(0.02)

        def is_mapped() -> bool:
            sensor.spin_once(0.1)
            teammate.exchange(time.monotonic())
            return counts[-1] == n_before + len(later)

        until(is_mapped, "the mapping of the later scans")
        second.send_signal(signal.SIGINT)
        while second.poll() is None:
            teammate.exchange(time.monotonic())
            time.sleep(0.05)
    transport.close()
    assert 0 < n_before <= index + 1
    (row,) = json.loads((folder / "results.json").read_text())["rows"]
    assert row["n_scans"] == n_before + len(later)
    found = GaussianMap.load(folder / "map.safetensors").components()
    assert torch.equal(found.means, mapped([*range(n_before), *later]).components().means)
    team = GaussianMap.load(folder / "team_map.safetensors").components()
    assert content(team) == content(teammate.replica.components()) == content(found, seen)
    assert row["team"]["digest"] == teammate.replica.digest().hex()
