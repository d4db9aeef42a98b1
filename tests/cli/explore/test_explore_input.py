"""gmmtorch-explore: bad input is named before the first tick."""

from __future__ import annotations

import re
import sys
from types import SimpleNamespace

import pytest
from cli.command_runs import QUIET, refused, run_here
from cli.explore.explore_cases import SMALL

from gmmtorch.team.cli.explorations import warn_of_robots_at_their_start


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("team.size=0", "team.size=0"),
        ("team.size=99", "team.size=99 31"),
        ("team.start=[[0,3,1.5,0],[3,3,1.5,0]]", "team.start[0] surface"),
        ("team.start=[[3,3,1.5,0],[50,3,1.5,0]]", "team.start[1] outside bounds room"),
        ("team.start=[[3,3,1.5,0],[3,3.2,1.5,0]]", "team.start[1] touches"),
        ("team.start=[[3,3,1.5,a],[2,2,1.5,0]]", "team.start"),
        ("team.start=3", "team.start"),
        ("team.start=[[nan,3,1.5,0],[2,2,1.5,0]]", "team.start[0] finite"),
        ("world.path=/no/where.ply", "world.path=/no/where.ply"),
        ("world.bounds=[20,20,0,30,30,3]", "world.bounds=[20.0, do not meet room"),
        ("world.bounds=[0,0,0,3]", "world.bounds= six"),
        ("world.resolution=0", "world.resolution=0.0"),
        ("sensor.width=0", "sensor.width=0"),
        ("sensor.max_range=0.05", "sensor.max_range no longer DepthCamera"),
        ("duration=2.5", "duration=2.5 sensor.rate"),
        ("sensor.rate=0.7", "sensor.rate=0.7 dynamics.duration"),
        ("duration=-1", "duration=-1.0"),
        ("network.loss=1", "network.loss=1.0"),
        ("network.reach=-1", "network.reach=-1.0"),
        ("network.partitions=[{begin:0,end:1,groups:[[0,1]]}]", "network.partitions[0].groups= leave it out"),
        ("network.partitions=[cut]", "network.partitions[0]='cut'"),
        ("network.announce=0", "network.announce=0.0 seconds"),
        ("network.budget=0", "network.budget=0.0 bytes"),
        ("map.side=0", "map.side=0.0"),
        ("map.noise=0.05", "map.noise map.side"),
        ("information=x", "information='x' csqmi fsmi"),
        ("coordination=x", "coordination='x' myopic greedy"),
        ("rounds=2", "rounds no longer three"),
        ("codec=thesis", "codec no longer team=gmm_thesis"),
        ("experiment=fig4_4_entropy study.variants=[{codec:zip}]", "codec='zip' quantized thesis"),
        ("transport=zenoh", "transport='zenoh' in_process"),
        ("evaluation.codecs=[jpeg]", "evaluation.codecs 'jpeg' octree draco"),
        ("evaluation.every=0", "evaluation.every=0.0"),
        ("robot.radius=5", "robot.radius no longer Dynamics"),
        ("runtime.threads=0", "runtime.threads=0"),
        ("runtime.device=meta", "runtime.device=meta"),
        ("seed=-1", "seed=-1"),
        ("experiment=fig4_4_entropy workers=0", "workers=0"),
        ("experiment=fig4_4_entropy study.name=other", "study.name='other' trials"),
        ("experiment=fig4_4_entropy study.variants=[]", "study.variants study.seeds"),
        ("planner.rest=0", "planner.rest no longer TeamOptions.rest"),
        ("experiment=fig4_4_entropy study.variants=[{colour:1}]", "study.variants colour team planner"),
        ("experiment=fig4_4_entropy study.variants=[{team:x}]", "team='x' gmm_shared"),
        ("experiment=fig4_4_entropy study.variants=[{announce:0}]", "study.variants: announce=0"),
        (
            "experiment=fig4_4_entropy study.variants=[{planner:random},{loss:1}]",
            "study.variants: loss=1",
        ),
        ("experiment=fig4_4_entropy study.variants=[{loss:high}]", "loss"),
        ("experiment=fig4_4_entropy study.seeds=[]", "study.seeds"),
    ],
)
def test_a_bad_value_is_named_in_one_line_before_the_first_tick(options, words, run, steps):
    line = refused(run(*options.split()))
    assert steps == []
    for word in words.split():  # as a whole: duration= is not robot.duration=
        assert re.search(rf"(?<![\w.]){re.escape(word)}", line), (word, line)


def test_a_recording_without_rerun_is_found_before_the_first_tick(run, steps, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'gmmtorch[viewer]'" in refused(run("report.recording=true"))
    assert steps == []


def test_a_missing_mesh_is_named(monkeypatch, tmp_path):
    line = refused(run_here(monkeypatch, "explore", tmp_path / "run", *QUIET, *SMALL, "world=mesh"))
    assert "world=mesh needs world.path=FILE" in line


@pytest.mark.parametrize(("world", "size"), [("warehouse", "[12,10,3.5]"), ("tunnels", "[nan,20,4]")])
def test_a_too_small_world_names_the_least_size(world, size, monkeypatch, tmp_path):
    options = [*QUIET, *SMALL, f"world={world}", f"world.size={size}"]
    assert "at least (" in refused(run_here(monkeypatch, "explore", tmp_path / "run", *options))


@pytest.mark.parametrize("kind", ["truncated.ply", "cloud.xyz", "text.stl"])
def test_a_file_that_is_not_a_mesh_is_named(kind, run, tmp_path):
    path = tmp_path / kind
    header = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
    header += "element face 1\nproperty list uchar int vertex_indices\nend_header\n"
    texts = {"truncated.ply": f"{header}0 0 0\n1 0 0\n", "cloud.xyz": "0 0 0\n1 1 1\n"}
    path.write_text(texts.get(kind, "no mesh at all\n"))
    assert str(path) in refused(run(f"world.path={path}"))


def test_half_a_mesh_is_rejected(run, tmp_path, room):
    path = tmp_path / "half.obj"
    path.write_text(room.read_text()[:-60])
    line = refused(run(f"world.path={path}"))
    assert "half" in line


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ("duration=long", "duration=long could not be converted to Float"),
        (
            "world.size=[10,10,3]",
            "world.size is not an option with world=mesh another choice of world= has it",
        ),
    ],
)
def test_wrong_types_and_unknown_options_are_explained_without_a_traceback(option, words, run):
    done = run(option)
    assert done.status == 1
    assert "Traceback" not in done.stderr
    assert all(word in done.stderr for word in words.split()), done.stderr
    assert not done.folder.exists()


def test_robots_that_never_left_their_start_are_reported(caplog):
    robots = [
        SimpleNamespace(number=number, path_length=length) for number, length in enumerate((0.0, 3.0, 0.0))
    ]
    warn_of_robots_at_their_start(SimpleNamespace(robots=robots, elapsed=29.0))
    assert not caplog.messages
    warn_of_robots_at_their_start(SimpleNamespace(robots=robots, elapsed=30.0))
    (said,) = caplog.messages
    assert "0, 2" in said
    assert "team.start" in said
    warn_of_robots_at_their_start(SimpleNamespace(robots=robots[1:2], elapsed=60.0))
    assert len(caplog.messages) == 1
