"""gmmtorch-fit and gmmtorch-occupancy: files, output and errors."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from command_runs import (
    CHECKOUT,
    QUIET,
    TINY,
    Finished,
    environment,
    refused,
    run_here,
    run_script,
    shrink,
    succeeded,
    timeless,
)

import gmmtorch
from gmmtorch import GaussianMap, GaussianMixture, OccupancyGrid
from gmmtorch.experiments.studies import ComponentCountStudy, InitializationStudy, SensorModelStudy
from gmmtorch.mixture import LaserModel

Run = Callable[..., Finished]
OCCUPANCY_FIELDS = {
    "dataset", "method", "resolution", "removal", "kept", "auc", "brier", "n_train_points", "n_components",
    "nbytes", "build_seconds", "query_seconds", "n_queries",
}  # fmt: skip
FIT_FIELDS = {
    "dataset", "method", "n_points", "n_components", "seconds", "n_iterations", "log_likelihood", "psnr2_db",
    "nbytes",
}  # fmt: skip
STRATEGIES = ["experiment=strategies", "method=[em,hierarchical,scikit_learn]", "max_points=150"]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Run:
    """Runs a small command in this process, without figures unless the options request them."""

    def run_command(command: str, *options: str, name: str = "run") -> Finished:
        return run_here(monkeypatch, command, tmp_path / name, *TINY[command], *QUIET, *options)

    return run_command


# -- a whole run ----------------------------------------------------------------------------------


def whole(command: str, folder: Path, *options: str) -> Finished:
    with pytest.MonkeyPatch.context() as patch:
        return succeeded(run_here(patch, command, folder, *TINY[command], *options))


@pytest.fixture(scope="module")
def occupancy_run(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return whole("occupancy", tmp_path_factory.mktemp("occupancy") / "run")


@pytest.fixture(scope="module")
def fit_run(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    return whole("fit", tmp_path_factory.mktemp("fit") / "run", *STRATEGIES)


@pytest.fixture(params=["occupancy", "fit"])
def whole_run(request: pytest.FixtureRequest) -> tuple[str, Finished]:
    finished: Finished = request.getfixturevalue(f"{request.param}_run")
    return request.param, finished


def test_results_have_the_documented_fields(whole_run):
    command, done = whole_run
    results = done.results()
    assert list(results) == ["command", "version", "seed", "config", "rows"]
    assert results["command"] == command
    assert results["version"] == gmmtorch.__version__
    assert results["seed"] == results["config"]["seed"] == 0
    extra = {"detail": False} if command == "occupancy" else {}
    assert results["config"]["report"] == {"progress": True, "figures": True, "tensorboard": True, **extra}
    fields = OCCUPANCY_FIELDS if command == "occupancy" else FIT_FIELDS
    assert [row["method"] for row in results["rows"]] == results["config"]["method"]
    for row in results["rows"]:
        assert fields <= row.keys()
        assert all(isinstance(value, str | int | float | bool | None) for value in row.values())


def test_run_directory_contains_results_figures_events_and_configuration(whole_run):
    command, done = whole_run
    files = done.files()
    assert {"results.json", ".hydra/config.yaml", ".hydra/overrides.yaml", ".hydra/hydra.yaml"} <= files
    of_occupancy = "auc_against_kept map_0.1m mixture reliability_0.1m roc_0.1m"
    methods = [row["method"] for row in done.results()["rows"]]
    of_fit = ["comparison", "convergence", *(f"mixture_{method}" for method in methods)]
    expected = {f"{name}.png" for name in (of_occupancy.split() if command == "occupancy" else of_fit)}
    assert {name for name in files if name.endswith(".png")} == expected
    for name in expected:
        assert (done.folder / name).read_bytes().startswith(b"\x89PNG")
    assert any(name.startswith("tensorboard/events.out.tfevents") for name in files)
    assert not [name for name in files if Path(name).name.startswith(".") and "/" not in name]


def test_a_table_and_the_paths_are_printed(whole_run):
    _, done = whole_run
    rows = done.results()["rows"]
    lines = done.stdout.splitlines()
    heading = next(i for i, line in enumerate(lines) if line.startswith("method "))
    assert set(lines[heading + 1]) == {"-", " "}
    for line, row in zip(lines[heading + 2 :], rows, strict=False):
        assert line.split()[0] == row["method"]
    assert rows[0]["dataset"] in done.stdout
    assert str(done.folder / "results.json") in done.stdout
    assert f"tensorboard --logdir {done.folder / 'tensorboard'}" in done.stdout
    assert "nan" not in done.stdout.lower()


def test_progress_is_written_to_standard_error(whole_run):
    command, done = whole_run
    assert ("mixture" if command == "occupancy" else "em") in done.stderr
    assert "Traceback" not in done.stderr
    assert "Warning" not in done.stderr
    assert "%|" not in done.stdout


def test_event_files_contain_scalars_figures_and_hyperparameters(occupancy_run, fit_run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    for done, method in ((occupancy_run, "point"), (fit_run, "em")):
        events = EventAccumulator(str(done.folder / "tensorboard")).Reload()
        tags = events.Tags()
        assert "results/text_summary" in tags["tensors"]
        for tag in tags["scalars"]:
            assert len({event.step for event in events.Scalars(tag)}) > 1, f"{tag} is one dot"
        assert (f"{method}/lower_bound" in tags["scalars"]) == (method == "em")
        assert any(tag.startswith("figures/") for tag in tags["images"])
        assert any(tag.startswith("_hparams_") for tag in events.summary_metadata)


def test_fitted_mixtures_are_saved(fit_run):
    for row in fit_run.results()["rows"]:
        assert {"held_out_psnr2_db", "n_components_used"} <= row.keys()
        path = fit_run.folder / f"{row['method']}.safetensors"
        assert path.stat().st_size == row["nbytes"]
        assert GaussianMixture.load(path).means_.shape == (row["n_components"], 3)


@pytest.mark.slow
def test_the_script_gives_the_same_results_in_another_process(whole_run, tmp_path):
    command, done = whole_run
    more = STRATEGIES if command == "fit" else []
    other = succeeded(run_script(command, tmp_path / "run", *TINY[command], *more, *QUIET))
    again, results = timeless(other.results()), timeless(done.results())
    assert again["rows"] == results["rows"]
    for config in (again["config"], results["config"]):
        del config["report"]
    assert again == results


# -- options --------------------------------------------------------------------------------------


def test_rows_depend_only_on_the_seed_and_reports_only_on_their_options(whole_run, run):
    command, done = whole_run
    more = STRATEGIES if command == "fit" else []
    only = "method=[em,scikit_learn]" if command == "fit" else "report.tensorboard=true"
    score = "log_likelihood" if command == "fit" else "auc"
    again, other = (succeeded(run(command, *more, only, f"seed={seed}", name=str(seed))) for seed in (0, 1))
    first = {row["method"]: row for row in timeless(done.results())["rows"]}
    for row, other_row in zip(timeless(again.results())["rows"], other.results()["rows"], strict=True):
        assert row == first[row["method"]]
        assert row[score] != other_row[score]
    assert again.stderr == ""
    assert not [name for name in again.files() if name.endswith(".png")]
    assert any("tfevents" in name for name in again.files()) == (command == "occupancy")


def test_every_share_resolution_and_method_has_a_row_and_a_saved_map(run, tmp_path):
    done = succeeded(
        run(
            "occupancy",
            "method=[occupancy_log_odds,monte_carlo,occupancy_grid]",
            "evaluation.kept=[1.0,0.5]",
            "evaluation.resolution=[0.2,0.1]",
            "evaluation.unknown=true",
            "evaluation.removal=scans",
            "evaluation.pose_noise=[0.01,0.01]",
            f"evaluation.save_map={tmp_path / 'maps'}",
            f"evaluation.save_queries={tmp_path / 'queries.npz'}",
            "map=per_scan",
        )
    )
    rows = done.results()["rows"]
    assert len({(row["method"], row["kept"], row["resolution"]) for row in rows}) == len(rows) == 12
    assert all("unknown_auc" in row and row["removal"] == "scans" for row in rows)
    assert (tmp_path / "queries.npz").is_file()
    for row in rows:
        path = tmp_path / "maps" / f"{row['method']}_{row['kept']:g}_{row['resolution']:g}.safetensors"
        kind = GaussianMap if row["method"] == "monte_carlo" else OccupancyGrid
        assert kind.load(path).nbytes == row["nbytes"] == path.stat().st_size


# -- experiments ----------------------------------------------------------------------------------


def test_initialization_study(run):
    options = [
        "study.n_components=[2,5]",
        "study.seeds=[0,1]",
        "report.figures=true",
        "report.tensorboard=true",
    ]
    done = succeeded(run("fit", "experiment=fig2_1_initialization", *options))
    results = done.results()
    starts = InitializationStudy().init_params
    assert len(results["rows"]) == 2 * 2 * len(starts)
    for row in results["rows"]:
        assert FIT_FIELDS | {"init_params", "seed", "init_seconds", "em_seconds"} <= row.keys()
        assert row["n_points"] == 200
    files = done.files()
    assert {name for name in files if name.endswith(".png")} == {
        "initialization.png",
        "initialization_quality.png",
    }
    assert any("tfevents" in name for name in files)
    table = [line.split()[:3] for line in done.stdout.splitlines() if line.startswith("kmeans ")]
    assert table == [["kmeans", "2", "2"], ["kmeans", "5", "2"]]


def test_sensor_model_study(run, monkeypatch):
    small = {"n_points": 300, "max_beams": 200, "test_every": 3, "resolution": 0.5, "n_samples": 5000}
    shrink(monkeypatch, SensorModelStudy, sensor=LaserModel(), **small)
    done = succeeded(
        run(
            "fit",
            "experiment=sensor_model",
            "dataset=synthetic_building_2d",
            "dataset.n_scans=6",
            "study.n_components=[4]",
            "report.figures=true",
        )
    )
    rows = done.results()["rows"]
    assert [row["method"] for row in rows] == ["plain", "planar", "noise", "noise_planar"]
    for row in rows:
        assert FIT_FIELDS | {"held_out_log_likelihood", "auc", "thickness"} <= row.keys()
        assert row["n_points"] == 300
        assert row["psnr2_db"] is None  # not measured
    assert "sensor_model.png" in done.files()


def test_component_count_study(run, monkeypatch):
    small = {"window": 3, "max_beams": 200, "test_every": 3, "resolution": 0.5, "n_samples": 5000}
    rules = {"multiples": (1.0,), "bandwidths": (0.4,), "window_components": (4,)}
    shrink(monkeypatch, ComponentCountStudy, **small, **rules)
    done = succeeded(
        run(
            "fit",
            "experiment=automatic_components",
            "dataset=synthetic_building_2d",
            "dataset.n_scans=6",
            "study.n_components=[2,4]",
            "report.figures=true",
            "report.tensorboard=true",
        )
    )
    rows = done.results()["rows"]
    fits = ["fixed", "fixed", "flat_pieces", "mean_shift", "hierarchical", "bic"]
    assert [row["rule"] for row in rows] == [*fits, "map_flat_pieces", "map_fixed"]
    assert all(FIT_FIELDS | {"setting", "auc", "component_bytes"} <= row.keys() for row in rows)
    assert "component_count.png" in done.files()
    assert any("tfevents" in name for name in done.files())


def test_forms_that_integrate_over_cells_are_drawn_in_3d(run):
    options = ["dataset=synthetic_building", "dataset.n_scans=4", "evaluation.test_every=4"]
    forms = ["method=[flux,cone,occupancy_grid]", "evaluation.resolution=[0.5]", "evaluation.max_beams=200"]
    done = succeeded(run("occupancy", *options, *forms, "report.figures=true"))
    assert "map_0.5m.png" in done.files()


def test_the_number_of_components_can_be_automatic(run):
    done = succeeded(run("fit", "mixture.n_components=null", "mixture.noise=10"))
    assert done.results()["rows"][0]["n_components"] == 1


# -- errors ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("method=[octree]", "method='octree' known monte_carlo occupancy_grid occupancy_log_odds"),
        ("evaluation.resolution=[1e-9]", "resolution=1e-09 fits"),
        ("evaluation.kept=[0]", "evaluation.kept=0.0 share"),
        ("evaluation.pose_noise=[0.1]", "evaluation.pose_noise=[0.1]"),
        ("map.noise=0", "map.noise=0.0"),
        ("map.max_bytes=10 method=[point]", "max_bytes=10"),
        ("map.novelty={resolutoin:1}", "map.novelty resolutoin threshold"),
        ("map.novelty={threshold:-1}", "map.novelty.threshold=-1"),
        ("dataset.stride=0", "stride=0"),
        ("dataset.n_scans=1", "1 scans at least 2"),
        ("dataset.max_range=0.01", "no return beams dataset.max_range"),
        ("runtime.device=foo", "runtime.device=foo cpu"),
        ("runtime.dtype=float16", "dtype='float16' float32 float64"),
        ("runtime.memory_limit=1000 method=[occupancy_grid]", "1,000"),
        ("seed=-1", "seed=-1"),
        ("evaluation.save_map=/dev/null/maps", "/dev/null/maps"),
    ],
)
def test_an_invalid_map_option_gives_a_one_line_error(options, words, run):
    line = refused(run("occupancy", *options.split()))
    assert all(word in line for word in words.split()), line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ("method=[kmeans]", "method='kmeans' em scikit_learn"),
        ("method=[]", "method"),
        ("dataset=carmen", "dataset.path is not set FLASER"),
        ("dataset=scan_folder dataset.path=/no/where", "dataset.path=/no/where does not exist poses.txt"),
        ("scans=[99]", "scans=[99] 0 39"),
        ("max_points=0", "max_points=0"),
        ("mixture.n_components=9999", "n_components=9999"),
        ("mixture.n_components=null method=[scikit_learn]", "mixture.n_components=None scikit_learn"),
        ("experiment=fig2_1_initialization study.seeds=[-1]", "study.seeds=-1"),
        ("experiment=fig2_1_initialization study.n_components=[999]", "n_components=999 200"),
        ("+method_options.em.branching=2", "method_options.em.branching warm_start"),
        ("+method_options.hierarchical.branching=1 method=[hierarchical]", "branching=1"),
        ("experiment=fig2_1_initialization study.name=history", "study.name='history' initialization"),
    ],
)
def test_an_invalid_fit_option_gives_a_one_line_error(options, words, run):
    line = refused(run("fit", *options.split()))
    assert all(word in line for word in words.split()), line


@pytest.mark.slow
def test_a_process_with_an_error_prints_one_line_and_exits_with_one(tmp_path):
    done = run_script("occupancy", tmp_path / "run", "method=[octree]")
    assert "octree" in refused(done)
    assert done.stdout == f"gmmtorch-occupancy writes to {done.folder}\n"


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX signals")
def test_ctrl_c_leaves_only_complete_files(tmp_path):
    maps, folder = tmp_path / "maps", tmp_path / "run"
    shares = ",".join(f"{0.9 - 0.001 * i:.3f}" for i in range(500))
    process = subprocess.Popen(
        [
            # Shells ignore SIGINT in processes that they start in the background.
            *("sh", "-c", "trap '' INT; exec \"$@\"", "sh"),
            sys.executable,
            str(CHECKOUT / "scripts" / "occupancy.py"),
            f"hydra.run.dir={folder}",
            f"evaluation.save_map={maps}",
            f"evaluation.kept=[{shares}]",
            *TINY["occupancy"],
            *QUIET,
        ],
        cwd=tmp_path,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        deadline = time.monotonic() + 300
        while time.monotonic() < deadline and process.poll() is None:
            if len(list(maps.glob("[!.]*.safetensors"))) >= 2:  # a temporary file begins with a dot
                break
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=120)
    finally:
        process.kill()
    assert process.returncode == 130
    assert stderr.splitlines() == ["gmmtorch: interrupted; all files that were written are complete."]
    # Finished files are complete; the others are absent.
    results = json.loads((folder / "results.json").read_text())
    written = list(maps.iterdir())
    assert 1 <= len(results["rows"]) <= len(written)  # a map is written just before its row
    assert 2 <= len(written) < 1000
    assert all(path.suffix == ".safetensors" and not path.name.startswith(".") for path in written)
    for path in written:
        kind = GaussianMap if path.name.startswith("point") else OccupancyGrid
        assert kind.load(path).nbytes > 0
