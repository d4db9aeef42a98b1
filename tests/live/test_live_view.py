"""The live view: real clients that come and go, what they receive, and what it costs without them."""

from __future__ import annotations

import logging
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from gmmtorch.datasets import load
from gmmtorch.mapping.gaussian_map import GaussianMap

pytest.importorskip("viser")

from viser_client import Client, wait_until

from gmmtorch.live.live_view import CurveRecord, LiveView, Moment, ViewedCells, ViewedRobot
from gmmtorch.team.exploration.mission.robot_view import camera_rotation


@pytest.fixture(scope="module")
def built() -> GaussianMap:
    torch.set_num_threads(1)
    made = GaussianMap()
    for scan in load("synthetic_building", n_scans=2):
        made.insert(scan.select(torch.arange(scan.n_beams) % 16 == 0))
    return made


@pytest.fixture
def view() -> Iterator[LiveView]:
    made = LiveView(port=8411)
    yield made
    made.stop()
    made.stop()


def robots(n_poses: int) -> list[ViewedRobot]:
    """Two robots with cameras after some poses."""
    path = torch.stack(
        [torch.arange(n_poses) * 0.5 + 2, torch.ones(n_poses), torch.ones(n_poses)], 1
    ).double()
    ahead = path[-1] + torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [1.0, 0, 0]])
    return [
        ViewedRobot(number, path + number, camera_rotation(0.3), (1.5, 1.0), ahead) for number in range(2)
    ]


def moment(built: GaussianMap, n_poses: int = 4) -> Moment:
    """A map, two robots and a curve."""
    times = [float(k) for k in range(n_poses)]
    return Moment(built, robots(n_poses), times, {"entropy left [%]": {"team": times[::-1]}})


def test_without_a_browser_nothing_is_taken_and_nothing_is_drawn(view, built):
    for _ in range(3):
        view.offer(lambda: pytest.fail("a moment was taken"))
    assert view.n_drawn == 0


def test_two_browsers_see_components_robots_and_curves(view, built):
    with Client(view.url) as first, Client(view.url) as second:
        wait_until(lambda: view.viewer.n_viewers == 2)
        view.offer(lambda: moment(built))
        for client in (first, second):
            client.received(b"/components", b"/paths/1", b"/robots/1/camera", b"entropy left [%]")
        with Client(view.url) as third:  # one that comes later sees the same
            third.received(b"/components", b"/paths/1", b"/robots/1/camera", b"entropy left [%]")
    assert view.viewer.server.scene.get_handle_by_name("/robots/0") is not None


def test_a_browser_that_goes_away_stops_nothing(view, built, caplog):
    caplog.set_level(logging.WARNING)
    lost, other = Client(view.url), Client(view.url)
    wait_until(lambda: view.viewer.n_viewers == 2)
    view.offer(lambda: moment(built))
    lost.cut()
    with other:
        wait_until(lambda: view.n_drawn == 1)
        wait_until(lambda: view.viewer.n_viewers == 1)
        wait_until(lambda: view.offer(lambda: moment(built, 9)) or view.n_drawn == 2)
    wait_until(lambda: view.viewer.n_viewers == 0)
    view.offer(lambda: pytest.fail("a moment was taken"))
    assert not [record for record in caplog.records if record.name.startswith("gmmtorch")]


def test_moments_are_taken_no_faster_than_they_are_due(view, built):
    taken = []
    with Client(view.url):
        wait_until(lambda: view.viewer.n_viewers == 1)
        for _ in range(50):
            view.offer(lambda: taken.append(0) or moment(built))
    assert len(taken) == 1


def test_the_last_moment_is_drawn_for_browsers_to_come(view, built):
    view.finish(lambda: moment(built))
    assert view.n_drawn == 1
    with Client(view.url) as late:
        late.received(b"/components", b"/robots/0/body")


def test_robots_stand_at_the_end_of_their_paths_and_look_along_their_cameras(view, built):
    view.finish(lambda: moment(built))
    frame = view.viewer.server.scene.get_handle_by_name("/robots/1")
    np.testing.assert_allclose(frame.position, robots(4)[1].path[-1])
    w, x, y, z = frame.wxyz
    ahead = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]  # third column of R(q)
    np.testing.assert_allclose(ahead, [np.cos(0.3), np.sin(0.3), 0], atol=1e-9)


def test_maps_of_cells_are_shown_as_cubes(view):
    cells = ViewedCells(torch.tensor([[0.1, 0.1, 0.1], [0.1, 0.1, 2.3]], dtype=torch.float64), 0.2)
    view.finish(lambda: Moment(cells, robots(3)))
    node = view.viewer.server.scene.get_handle_by_name("/components")
    np.testing.assert_allclose(node.batched_positions, cells.centres, rtol=1e-6)
    assert np.ptp(node.vertices, axis=0) == pytest.approx(0.2)


def test_an_error_while_drawing_is_logged_and_stops_nothing(view, built, caplog):
    view.finish(lambda: Moment(built, [], [0.0, 1.0], {"broken": {"curve": [1.0]}}))
    assert "could not draw" in caplog.text
    view.finish(lambda: moment(built))
    assert view.n_drawn == 1


def test_the_camera_follows_the_map_until_its_user_moves_it(view, built):
    with Client(view.url):
        wait_until(lambda: view.viewer.n_viewers == 1)
        (client,) = view.viewer.server.get_clients().values()
        view.finish(lambda: moment(built))
        first = np.array(client.camera.position)
        assert np.linalg.norm(first) > 1  # the client said that it was at the origin, where new ones begin
        view.finish(lambda: moment(built, 60))
        assert np.linalg.norm(np.array(client.camera.position) - first) > 1
        client.camera.position = (1.0, 2.0, 3.0)
        view.finish(lambda: moment(built, 200))
        assert tuple(client.camera.position) == (1.0, 2.0, 3.0)


def test_the_next_port_is_taken_if_one_is_in_use(view):
    other = LiveView(port=8411)
    try:
        assert other.url != view.url
        with Client(other.url), Client(view.url):
            wait_until(lambda: other.viewer.n_viewers == view.viewer.n_viewers == 1)
    finally:
        other.stop()


def test_curves_are_thinned_evenly():
    record = CurveRecord()
    for k in range(5000):
        record.add(float(k), lambda k=k: {"size": {"map": 2.0 * k}})
    times, curves = record.copy()
    assert 300 <= len(times) < 800
    assert curves["size"]["map"] == [2 * time for time in times]
    steps = np.diff(times)
    assert steps.max() <= 4 * steps.min()
    assert times[0] == 0
