"""Fixtures of all tests: one thread, reproducible hypothesis examples, and the folder of real data."""

from __future__ import annotations

import os
import signal
import socket
import tempfile

os.environ.setdefault("OMP_NUM_THREADS", "1")  # k-means has threads of its own

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, settings

pytest.register_assert_rewrite(
    "occupancy.protocol_contract", "mixture.estimator_contract", "mixture.fit_contract"
)

# A shell that starts a job in the background makes it ignore SIGINT, and its children inherit that.
signal.signal(signal.SIGINT, signal.default_int_handler)
torch.set_num_threads(1)
settings.register_profile(
    "gmmtorch",
    derandomize=True,
    deadline=None,
    max_examples=30,
    suppress_health_check=[
        HealthCheck.function_scoped_fixture,
        HealthCheck.too_slow,
        HealthCheck.differing_executors,  # a contract's tests run in every class that inherits it
    ],
)
settings.register_profile("long", settings.get_profile("gmmtorch"), derandomize=False, max_examples=20_000)
settings.load_profile("gmmtorch")


@pytest.fixture(autouse=True)
def _single_thread():
    torch.set_num_threads(1)


@pytest.fixture
def generator() -> torch.Generator:
    """A seeded source of random numbers."""
    return torch.Generator().manual_seed(0)


@pytest.fixture
def real_data() -> Path:
    """The folder of real scans; skips where there is none."""
    root = os.environ.get("GMMTORCH_DATA")
    if not root:
        pytest.skip("GMMTORCH_DATA is not set")
    path = Path(root)
    if not path.is_dir():
        pytest.skip(f"{path} is not there")
    return path


@pytest.fixture
def steps(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of ticks done, at the start of every tick of missions in this process."""
    from gmmtorch.team.exploration.mission.mission import Mission

    ticks: list[int] = []
    tick = Mission.tick

    def noted(mission: Mission, now: float) -> None:
        ticks.append(mission.n_ticks)
        tick(mission, now)

    monkeypatch.setattr(Mission, "tick", noted)
    return ticks


@pytest.fixture
def ros_domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain that no other process of the tests uses meanwhile; also that of commands."""
    fcntl = pytest.importorskip("fcntl", reason="needs locks of files, which Windows has not")
    for number in range(1, 100):
        with open(Path(tempfile.gettempdir()) / f"gmmtorch-test-domain-{number}", "w") as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
            yield number
            return
    pytest.fail("all domains are in use")


@pytest.fixture(params=["dds", "zenoh"])
def ros_options(request: pytest.FixtureRequest, ros_domain: int) -> Iterator[dict[str, Any]]:
    """Options of nodes over DDS, and over Zenoh with a router, that no other process hears."""
    package = {"dds": "cyclonedds", "zenoh": "zenoh"}[request.param]
    pytest.importorskip(package, reason=f"needs the extra [ros]: {package}")
    options = {"middleware": request.param, "domain": ros_domain}
    if request.param == "dds":
        yield options
        return
    from gmmtorch.live.ros.zenoh_middleware import open_router

    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        options["router"] = f"tcp/127.0.0.1:{found.getsockname()[1]}"
    router = open_router(options["router"])
    yield options
    router.close()
