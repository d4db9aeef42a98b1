"""Recordings for rerun, read back with rerun's reader."""

from __future__ import annotations

import importlib.util
import sys
from unittest.mock import MagicMock

import numpy as np
import pytest
import torch
from exploration_rows import flights, trial

from gmmtorch.errors import GmmTorchError, InvalidArgumentError
from gmmtorch.team.report.mission_maps import _log_robot, load_rerun, record_rerun

needs_rerun = pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="needs rerun-sdk")


@needs_rerun
def test_recording_contains_robots_map_mixture_and_curves(tmp_path):
    from rerun.chunk import RrdReader

    covariances = torch.eye(3).expand(2, 3, 3) * 0.01
    maps = {
        20.0: {"cells": [[0, 0, 0], [5, -1, 2]], "means": torch.rand(2, 3), "covariances": covariances},
        10.0: {"cells": [[0, 0, 0]]},
    }
    path = record_rerun(
        tmp_path / "mission.rrd", flights(2, 30), maps=maps, row=trial("gmm_shared", 0, duration=100)
    )
    assert [p.name for p in tmp_path.iterdir()] == ["mission.rrd"]
    rows: dict[str, int] = {}
    for chunk in RrdReader(str(path)).stream():
        rows[str(chunk.entity_path)] = rows.get(str(chunk.entity_path), 0) + chunk.num_rows
    found = {name: n for name, n in rows.items() if "__" not in name and n}
    assert found["/world/robots/0"] == found["/world/robots/1"] == 30
    assert found["/world/cells"] == found["/world/mixture"] == 2
    assert found["/entropy_left"] == found["/bytes_sent"] == 11
    assert found["/world/robots/0/path"] == 1
    assert "/world/robots/2" not in found


def test_recorded_robots_are_numbered_from_zero():
    stream = MagicMock()
    _log_robot(MagicMock(), stream, 0, flights(1, 3)[0], 1.0)
    names = {call.args[0] for call in stream.log.call_args_list}
    assert names == {"world/robots/0", "world/robots/0/path", "world/robots/0/heading"}


@needs_rerun
def test_empty_recordings_are_written(tmp_path):
    assert record_rerun(tmp_path / "empty.rrd", [np.empty((0, 4))]).is_file()


def test_recording_errors_name_the_argument(tmp_path, monkeypatch):
    with pytest.raises(InvalidArgumentError, match=r"must end in \.rrd"):
        record_rerun(tmp_path / "mission.bag", [])
    with pytest.raises(InvalidArgumentError, match="period=0"):
        record_rerun(tmp_path / "mission.rrd", [], period=0.0)
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(GmmTorchError, match=r"gmmtorch\[viewer\]"):
        record_rerun(tmp_path / "mission.rrd", [])
    with pytest.raises(GmmTorchError, match=r"gmmtorch\[viewer\]"):
        load_rerun()
    assert list(tmp_path.iterdir()) == []
