"""gmmtorch-robot: what is refused, and what a robot is warned of."""

from __future__ import annotations

import socket

import pytest
from cli.command_runs import as_it_was, composed, refused, room_mesh, succeeded
from cli.robot.robot_cases import LOG

from gmmtorch.team.cli import from_options
from gmmtorch.team.cli.from_options import facts_of
from gmmtorch.team.sharing import KEY_VARIABLE, Store


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("source=radio", "source='radio' world, log"),
        ("transport=pigeon", "transport='pigeon' udp, zenoh"),
        ("id=2 team.size=2", "id=2 team.size=2"),
        ("source=log", "source=log dataset@log.dataset=carmen"),
        ("source=log dataset@log.dataset=carmen log.dataset.path=/no/log", "log.dataset.path=/no/log"),
        ("link.listen=7400", "link.listen='7400' 127.0.0.1:7447"),
        ("link.listen=127.0.0.1:70000", "link.listen='127.0.0.1:70000'"),
        ("link.peers=[127.0.0.1]", "link.peers='127.0.0.1'"),
        ("link.listen=0.0.0.0:0", "link.listen='0.0.0.0' link.key_file"),
        ("link.group=239.71.77.7:7400 link.interface=10.1.2.3", "link.interface='10.1.2.3' link.key_file"),
        ("link.group=10.0.0.1:7400", "link.group='10.0.0.1' multicast"),
        ("link.group=239.71.77.7:0", "link.group='239.71.77.7:0'"),
        ("link.peers=[10.0.0.2:7400]", "link.peers= link.listen= 0.0.0.0"),
        ("link.key_file=/nowhere/team.key", "/nowhere/team.key openssl"),
        ("transport=zenoh link.listen=null", "link.listen=[] link.peers=[]"),
        ("transport=zenoh link.listen=tcp/10.0.0.3:7447", "link.listen='tcp/10.0.0.3:7447' link.key_file"),
        ("transport=zenoh link.peers=[10.0.0.3:7447]", "link.peers='tcp/10.0.0.3:7447' link.key_file"),
    ],
)
def test_a_bad_value_is_named_in_one_line(options, words, run):
    line = refused(run(*options.split()))
    for word in words.split():
        assert word in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("speed=0", "speed=0.0"),
        ("settle=inf", "settle=inf"),
        ("sensor.rate=0", "sensor.rate=0.0"),
    ],
)
def test_paces_are_checked_before_anything_is_opened(options, words, run, monkeypatch):
    monkeypatch.setattr(from_options, "open_link", None)
    assert words in refused(run(*LOG, options))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("log.dataset.stride=0", "log.dataset.stride=0"),
        ("log.map={prior:-1}", "log.map.prior=-1.0"),
        ("log.map={noise:loud}", "log.map={ loud"),
        ("log.map=windowed", "log.map=windowed name"),
        ("start=here", "start='here'"),
    ],
)
def test_a_bad_value_for_a_log_is_named_in_one_line(options, words, run):
    given = [option for option in LOG if option.split("=")[0] != options.split("=")[0]]
    line = refused(run(*given, *options.split()))
    for word in words.split():
        assert word in line


def test_an_address_of_another_machine_is_named_with_the_remedy(run, monkeypatch):
    monkeypatch.setenv(KEY_VARIABLE, "ab" * 32)
    line = refused(run("link.listen=198.51.100.7:0"))
    assert "link.listen=198.51.100.7:0" in line
    assert "0.0.0.0" in line


@pytest.mark.parametrize(
    ("option", "host", "remedy"),
    [
        ("link.listen", "127.0.0.1", "give another port, or 0 for any that is free."),
        ("link.group", "239.71.77.7", "give another port."),
    ],
)
def test_a_port_in_use_is_named_with_the_remedy(option, host, remedy, run):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("", 0))
        where = f"{option}={host}:{taken.getsockname()[1]}"
        line = refused(run(*LOG, where))
    assert f"{where} " in line
    assert "another process has that port" in line
    assert remedy in line


def test_a_robot_without_peers_is_warned_of(run):
    said = succeeded(run(*LOG, "team.size=2", "sensor.rate=50")).stdout
    assert "link.peers=[]: robot 0 sends to no other robot" in said


def test_a_store_of_another_log_is_rejected(run, tmp_path):
    kept = f"journal.folder={tmp_path / 'kept'}"
    said = f"{kept} holds no robot_0.sqlite: the map starts empty."
    assert said in succeeded(run(*LOG, "sensor.rate=50", kept)).stdout
    assert "stride" in refused(run(*LOG, "sensor.rate=50", kept, "log.dataset.stride=3", name="other"))
    again = succeeded(run(*LOG, "sensor.rate=40", kept, name="again"))  # the rate may change
    assert said not in again.stdout


def test_a_store_in_use_is_named_by_its_option(run, tmp_path):
    with Store(tmp_path / "robot_0.sqlite", 0, {}):
        line = refused(run(*LOG, f"journal.folder={tmp_path}"))
    assert "journal.folder=" in line
    assert "runs already" in line
    assert "path=" not in line


def facts(*options: str) -> dict[str, object]:
    return facts_of(composed("robot", *options))


def test_facts_that_identify_a_world(tmp_path):
    with as_it_was():
        warehouse = facts()
        for other in ("world=tunnels", "world.seed=1", "world.size=[20,20,8]"):
            assert facts(other) != warehouse, other
        for same in ("seed=3", "world.resolution=0.4", "team.size=2", "planner=random"):
            assert facts(same) == warehouse, same
        one, moved = room_mesh(tmp_path / "one.obj"), room_mesh(tmp_path / "moved.obj")
        meshes = [facts("world=mesh", f"world.path={path}") for path in (one, moved)]
        assert meshes[0] == meshes[1]
        one.write_text(one.read_text().replace("7.0", "7.5"))
        assert facts("world=mesh", f"world.path={one}") != meshes[0]
        assert facts("world=mesh") != meshes[0]
