"""Trials in TensorBoard, read back with TensorBoard's reader."""

from __future__ import annotations

import numpy as np
from exploration_rows import OBSERVABLE_BITS, flights, trial
from shown import read
from tensorboard.util.tensor_util import make_ndarray

from gmmtorch.report.tensorboard_writer import Board
from gmmtorch.team.report.trial_groups import write_exploration_board


def test_trials_are_written_with_their_tags(tmp_path):
    rows = [trial("gmm_shared", 0, duration=50), trial("grid_isolated", 1, duration=50)]
    with Board(tmp_path) as board:
        write_exploration_board(board, rows)
    events = read(tmp_path)
    left = events.Scalars("E0/seed_0/entropy_left")
    assert [event.step for event in left] == [0, 10, 20, 30, 40, 50]
    np.testing.assert_allclose(
        [event.value for event in left], np.array(rows[0]["entropy_bits"]) / OBSERVABLE_BITS, rtol=1e-6
    )
    tags = events.Tags()["scalars"]
    robots = {tag.split("/")[2] for tag in tags if tag.startswith("E0/seed_0/robot_")}
    assert robots == {"robot_0", "robot_1", "robot_2"}
    assert "E0/seed_0/octree_bytes_over_time" in tags
    assert "E2/seed_1/octree_bytes_over_time" not in tags
    assert "E2/seed_1/auc" not in tags  # one number, which is in the table
    table = make_ndarray(events.Tensors("results/text_summary")[0].tensor_proto)[0].decode()
    assert "| auc |" in table


def test_paths_are_written_as_points_of_all_robots(tmp_path):
    paths = flights(2, 30)
    with Board(tmp_path) as board:
        for n in (1, 10, 30):
            board.paths("paths", [path[:n] for path in paths], step=n)
        board.paths("none", [])
    events = read(tmp_path)
    clouds = events.Tensors("paths_VERTEX")
    assert [event.step for event in clouds] == [1, 10, 30]
    for event, n in zip(clouds, (1, 10, 30), strict=True):
        expected = np.concatenate([path[:n, :3] for path in paths])
        np.testing.assert_allclose(make_ndarray(event.tensor_proto)[0], expected, rtol=1e-6)
    assert not any("none" in tag for tag in events.Tags()["tensors"])


def test_variants_of_one_seed_have_different_tags(tmp_path):
    rows = [trial("gmm_shared", 0, duration=20, planner=name) for name in ("mcts", "random")]
    with Board(tmp_path) as board:
        write_exploration_board(board, rows)
    tags = read(tmp_path).Tags()["scalars"]
    assert sum(tag.endswith("/entropy_left") for tag in tags) == 2


def test_variants_that_differ_only_in_their_network_have_different_tags(tmp_path):
    cut = {"begin": 60.0, "end": 120.5, "groups": [[0], [1, 2]]}
    networks = [(0.0, []), (0.3, []), (0.0, [cut]), (0.0, [{**cut, "groups": [[1], [0, 2]]}])]
    rows = [
        trial("gmm_shared", 0, duration=20, loss=loss, partitions=cuts, missing_share=[0.0, 0.5, loss])
        for loss, cuts in networks
    ]
    with Board(tmp_path) as board:
        write_exploration_board(board, rows)
    events = read(tmp_path)
    tags = [tag for tag in events.Tags()["scalars"] if tag.endswith("/missing_share")]
    assert len(tags) == 4
    (lossy,) = (tag for tag in tags if "30 % lost" in tag)
    assert lossy == "30 % lost/seed_0/missing_share"
    found = events.Scalars(lossy)
    np.testing.assert_allclose([event.value for event in found], [0, 0.5, 0.3], rtol=1e-6)
    assert any("partition 0 | 1 2, 60–120.5 s" in tag for tag in tags)
