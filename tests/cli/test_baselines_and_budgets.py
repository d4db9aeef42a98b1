"""gmmtorch-occupancy with every method: saved maps, method options, and byte budgets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_runs import QUIET, Finished, refused, run_here, succeeded

from gmmtorch import GaussianMap, OccupancyGrid, datasets
from gmmtorch.experiments.baselines.bgk_map import BGKMap, BGKPointsMap
from gmmtorch.experiments.baselines.gp_map import GPMap
from gmmtorch.experiments.baselines.hilbert_map import BayesianHilbertMap, HilbertMap
from gmmtorch.experiments.baselines.ndt_map import NDTMap
from gmmtorch.experiments.baselines.octomap_map import OctoMapMap
from gmmtorch.experiments.evaluation import FREE, OCCUPIED, methods

Run = Callable[..., Finished]
BASELINES = {
    "occupancy_grid": OccupancyGrid,
    "occupancy_log_odds": OccupancyGrid,
    "hilbert": HilbertMap,
    "bayesian_hilbert": BayesianHilbertMap,
    "bgk": BGKMap,
    "bgk_points": BGKPointsMap,
    "gp": GPMap,
    "ndt": NDTMap,
    "octomap": OctoMapMap,
}
OURS = ("point", "flux", "cone", "monte_carlo")
SMALL = [*QUIET, "dataset.n_scans=8", "evaluation.resolution=[0.25]", "map.n_samples=20000"]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    def run_small(*options: str, name: str = "run") -> Finished:
        return run_here(monkeypatch, "occupancy", tmp_path / name, *SMALL, *options)

    return run_small


# -- every method ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def all_methods(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """One run of every method, with its maps in maps/ and its test points in queries.npz."""
    pytest.importorskip("pyoctomap")
    folder = tmp_path_factory.mktemp("all") / "run"
    options = [f"evaluation.save_map={folder / 'maps'}", f"evaluation.save_queries={folder / 'queries.npz'}"]
    names = ",".join([*OURS, *BASELINES])
    with pytest.MonkeyPatch.context() as patch:
        return succeeded(run_here(patch, "occupancy", folder, *SMALL, f"method=[{names}]", *options))


def test_all_methods_are_tested():
    assert set(methods(GaussianMap)) == {*OURS, *BASELINES}


@pytest.mark.parametrize("method", [*OURS, *BASELINES])
def test_a_saved_map_reproduces_its_row(method, all_methods):
    """The loaded file has the AUC, the Brier score and the bytes of the row at the saved test points."""
    (row,) = (row for row in all_methods.results()["rows"] if row["method"] == method)
    kind = BASELINES.get(method, GaussianMap)
    path = all_methods.folder / "maps" / f"{method}_1_0.25{kind.suffix}"
    assert path.suffix == (".ot" if method == "octomap" else ".safetensors")
    assert path.stat().st_size == row["nbytes"] > 0
    with np.load(all_methods.folder / "queries.npz") as asked:
        points, labels = asked["points"], asked["labels"]
    loaded = kind.load(path)
    theta = loaded.occupancy(points, 0.25)
    assert loaded.nbytes == row["nbytes"]
    assert len(theta) == row["n_queries"]
    occupied, free = theta[labels == OCCUPIED], theta[labels == FREE]
    assert np.mean([*((1 - occupied) ** 2), *(free**2)]) == pytest.approx(row["brier"], rel=1e-9)
    above = (occupied[:, None] > free[None]).mean() + (occupied[:, None] == free[None]).mean() / 2
    assert above == pytest.approx(row["auc"], rel=1e-9)
    assert row["auc"] > 0.7
    assert (row["n_components"] is None) == (method in BASELINES)


def test_library_answers_as_the_command(all_methods, tmp_path):
    """A map with the library's defaults is the map of `gmmtorch-occupancy`, to the bit."""
    with np.load(all_methods.folder / "queries.npz") as asked:
        points, train = asked["points"], asked["train_scans"].tolist()
    scans = datasets.load(all_methods.results()["rows"][0]["dataset"], n_scans=8)
    made = GaussianMap(resolution=0.25, n_samples=20_000)
    for number in train:
        made.insert(scans[number])
    saved = all_methods.folder / "maps" / "point_1_0.25.safetensors"
    made.save(tmp_path / "m.safetensors")
    assert (tmp_path / "m.safetensors").read_bytes() == saved.read_bytes()
    np.testing.assert_array_equal(made.occupancy(points), GaussianMap.load(saved).occupancy(points))


def test_forms_of_evidence_share_one_map(all_methods):
    maps = {path.name for path in (all_methods.folder / "maps").iterdir()}
    assert len(maps) == len(OURS) + len(BASELINES)
    rows = {row["method"]: row for row in all_methods.results()["rows"]}
    assert len({(rows[form]["n_components"], rows[form]["build_seconds"]) for form in OURS}) == 1


# -- options of one method ------------------------------------------------------------------------


def test_method_options_reach_their_baseline(run, tmp_path):
    options = "{bgk:{length:0.9,prior:0.01},ndt:{spread:3},hilbert:{features:nystroem,n_features:50}}"
    succeeded(
        run(
            "method=[bgk,ndt,hilbert,gp]",
            f"+method_options={options}",
            f"evaluation.save_map={tmp_path / 'maps'}",
        )
    )
    made = {
        name: BASELINES[name].load(tmp_path / "maps" / f"{name}_1_0.25.safetensors")
        for name in ("bgk", "ndt", "hilbert", "gp")
    }
    assert (made["bgk"].length, made["bgk"].prior) == (0.9, 0.01)
    assert made["ndt"].spread == 3
    assert (made["hilbert"].features, made["hilbert"].n_features) == ("nystroem", 50)
    assert made["gp"].length == 1.0  # its own default, not the length of bgk


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("+method_options={octree:{depth:16}}", "method_options.octree hilbert octomap map.*"),
        ("+method_options={point:{n_samples:1}}", "method_options.point map.*"),
        ("+method_options={bgk:{lenght:1}}", "method_options.bgk.lenght bgk length"),
        ("+method_options={bgk:0.6}", "method_options.bgk=0.6"),
        ("method=[point,bgk] +method_options={bgk:{length:-1}}", "length=-1"),
        ("method=[point,octomap] +method_options={octomap:{hit:high}}", "method_options.octomap type"),
    ],
)
def test_an_invalid_method_option_gives_a_one_line_error(options, words, run):
    line = refused(run(*options.split()))
    assert all(word in line for word in words.split()), line


# -- bytes ----------------------------------------------------------------------------------------


def test_saved_maps_keep_their_byte_budget(run, tmp_path):
    found = {}
    for limit in ("900", "null"):
        maps = tmp_path / f"maps_{limit}"
        done = succeeded(
            run(
                "method=[point]", f"map.max_bytes={limit}", f"evaluation.save_map={maps}", name=f"run_{limit}"
            )
        )
        (row,) = done.results()["rows"]
        assert (maps / "point_1_0.25.safetensors").stat().st_size == row["nbytes"]
        assert GaussianMap.load(maps / "point_1_0.25.safetensors").n_components == row["n_components"]
        found[limit] = row
    assert 450 < found["900"]["nbytes"] <= 900 < found["null"]["nbytes"]  # most of the budget is used
    assert found["900"]["n_components"] < found["null"]["n_components"]
