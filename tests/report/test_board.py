"""Events written by `Board`, read back with TensorBoard's reader."""

from __future__ import annotations

import io
import resource
import threading

import numpy as np
import pytest
import torch
from PIL import Image
from shown import read
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams import plugin_data_pb2
from tensorboard.util.tensor_util import make_ndarray

from gmmtorch.errors import OutputError
from gmmtorch.report import Board, picture, roc_figure, tensorboard_writer


def tensor(events: EventAccumulator, tag: str) -> np.ndarray:
    return make_ndarray(events.Tensors(tag)[-1].tensor_proto)


def test_board_writes_the_finite_numbers_of_a_row(tmp_path):
    row = {"auc": 0.5, "n": 3, "method": "x", "yes": True, "none": None, "nan": float("nan"), "list": [1.0]}
    with Board(tmp_path) as board:
        board.scalars(row, prefix="occupancy", step=0)
        board.scalars({"auc": np.float32(0.75)}, prefix="occupancy", step=4)
        board.scalars({"bare": 1})
    events = read(tmp_path)
    assert events.Tags()["scalars"] == ["occupancy/auc"]
    assert [(e.step, e.value) for e in events.Scalars("occupancy/auc")] == [(0, 0.5), (4, 0.75)]
    table = tensor(events, "results/text_summary")[0].decode().splitlines()
    assert table == ["|  | occupancy |  |", "| --- | --- | --- |", "| n | 3 |  |", "| bare |  | 1 |"]


def test_board_writes_figures_and_precision_recall_curves(tmp_path):
    labels, png = torch.tensor([0, 1, 1, 0, 1]), picture(roc_figure({}))
    with Board(tmp_path) as board:
        board.figure("maps", png)
        board.curve("grid", labels, torch.tensor([0.1, 0.9, 0.8, 0.6, 0.4]))
        board.curve("one_class", torch.ones(3), torch.rand(3))
        board.curve("none", torch.empty(0), torch.empty(0))
    events = read(tmp_path)
    assert sorted(events.Tags()["images"]) == ["grid/roc", "maps"]
    image = events.Images("maps")[0]
    assert image.encoded_image_string == png
    assert (image.width, image.height) == Image.open(io.BytesIO(png)).size
    assert sorted(events.Tags()["tensors"]) == ["grid", "one_class"]
    true_positives = tensor(events, "grid")[0]
    assert true_positives[0] == 3


@pytest.mark.parametrize("dim", [2, 3])
def test_clouds_are_thinned_deterministically(tmp_path, dim, monkeypatch):
    monkeypatch.setattr(tensorboard_writer, "_MAX_POINTS", 10)
    points = torch.arange(100 * dim, dtype=torch.float64).reshape(100, dim)
    colors = torch.full((100, 3), 300)
    for name in ("a", "b"):
        with Board(tmp_path / name) as board:
            board.cloud("scan", points, colors)
            board.cloud("one", points[:1])
            board.cloud("empty", points[:0])
    first, second = (read(tmp_path / name) for name in ("a", "b"))
    vertices = tensor(first, "scan_VERTEX")
    assert vertices.shape == (1, 10, 3)
    np.testing.assert_array_equal(vertices[0, :, :dim], points[::10])
    np.testing.assert_array_equal(vertices, tensor(second, "scan_VERTEX"))
    assert (tensor(first, "scan_COLOR") == 255).all()
    assert tensor(first, "one_VERTEX").shape == (1, 1, 3)
    assert not any("empty" in tag for tag in first.Tags()["tensors"])


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(("k", "n_vertices"), [(3, 3 * 162), (20, 20 * 25), (200, 41 * 12), (0, None)])
def test_ellipsoids_use_as_many_vertices_as_the_limit_permits(tmp_path, dim, k, n_vertices, monkeypatch):
    monkeypatch.setattr(tensorboard_writer, "_MAX_POINTS", 500)
    with Board(tmp_path) as board:
        board.ellipsoids("mixture", torch.zeros(k, dim), torch.eye(dim).expand(k, dim, dim))
    events = read(tmp_path)
    if n_vertices is None:
        assert events.Tags()["tensors"] == []
        return
    assert tensor(events, "mixture_VERTEX").shape == (1, n_vertices, 3)
    faces = tensor(events, "mixture_FACE")
    assert faces.max() == n_vertices - 1
    assert tensor(events, "mixture_COLOR").shape == (1, n_vertices, 3)


def test_hparams_are_written_to_the_same_run(tmp_path):
    config = {"seed": 0, "method": "point", "flag": True, "path": None, "kept": [1.0, 0.3]}
    with Board(tmp_path) as board:
        board.hparams(config, {"auc": 0.9, "missing": None})
    assert [p.is_file() for p in tmp_path.iterdir()] == [True]
    events = read(tmp_path)
    assert not events.Tags()["scalars"]  # a chart of one dot
    content = events.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    start = plugin_data_pb2.HParamsPluginData.FromString(content).session_start_info
    assert start.hparams["method"].string_value == "point"
    assert start.hparams["path"].string_value == "None"
    assert start.hparams["kept"].string_value == "[1.0, 0.3]"
    assert start.hparams["flag"].number_value == 1
    assert start.hparams["auc"].number_value == pytest.approx(0.9)


def test_a_full_disk_is_one_error_of_the_caller(tmp_path):
    """A limit of the file's size stands for the end of the disk. No thread has an error of its own."""
    unlimited = resource.getrlimit(resource.RLIMIT_FSIZE)
    board, n_threads = Board(tmp_path), threading.active_count()
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000, unlimited[1]))
    try:
        with pytest.raises(OutputError, match=f"{tmp_path} cannot be written: .*TensorBoard") as found, board:
            board.cloud("scan", torch.zeros(10_000, 3))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, unlimited)
    assert "\n" not in str(found.value)
    assert threading.active_count() == n_threads
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot be written"):
        Board(tmp_path / "file")
