"""Every configuration composes, and agrees with the library's own defaults."""

from __future__ import annotations

import importlib
import re
import shlex
from collections.abc import Iterator
from dataclasses import MISSING as REQUIRED
from dataclasses import asdict, fields, is_dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import pytest
from command_runs import CONF, as_it_was, composed, run_python
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf

from gmmtorch import datasets
from gmmtorch.cli import common, missions, occupancy_studies, schema, studies
from gmmtorch.errors import InvalidArgumentError, MissingDataError
from gmmtorch.evaluation import methods as contenders
from gmmtorch.evaluation.estimators import METHODS, FitOptions
from gmmtorch.evaluation.held_out import Protocol
from gmmtorch.evaluation.studies import (
    approximation_error,
    component_count,
    initialization_study,
    sensor_noise,
    variance_threshold,
)
from gmmtorch.exploration.mission.options import FRAMEWORKS, TeamOptions
from gmmtorch.exploration.mission.trials import WorldOptions
from gmmtorch.exploration.planning.planners import PLANNERS
from gmmtorch.mapping.gaussian_map import GaussianMap
from gmmtorch.mapping.learning.rules import IncrementalRule, WindowedRule
from gmmtorch.mapping.query_options import QueryOptions
from gmmtorch.simulation.worlds.tunnels import tunnels
from gmmtorch.simulation.worlds.warehouse import warehouse

COMMANDS = ["occupancy", "fit"]
CONFIGURED = [*COMMANDS, "explore", "robot", "team"]  # export has options of its own only: see its tests
MAPS = {
    "incremental": (schema.IncrementalMap, IncrementalRule()),
    "per_scan": (schema.WindowedMap, WindowedRule(window=1, max_origins=1)),
    "windowed": (schema.WindowedMap, WindowedRule()),
}
STUDIES = {
    "approximation_error": schema.ApproximationErrorStudy,
    "auc_memory": schema.AucMemoryStudy,
    "pose_correction": schema.PoseCorrectionStudy,
    "variance_threshold": schema.VarianceThresholdStudy,
    "component_count": schema.ComponentCountStudy,
    "initialization": schema.InitializationStudy,
    "sensor_model": schema.SensorModelStudy,
}


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


def listed(command: str) -> dict[str, list[str]]:
    """The choices of every group that a command's help names."""
    template = (CONF / f"{command}.yaml").read_text(encoding="utf-8")
    section = template.split("== Configuration groups ==")[1].split("== Options")[0]
    groups = re.split(r"(\w+):", section)[1:]
    return {name: re.findall(r"\w+", text) for name, text in zip(groups[::2], groups[1::2], strict=True)}


EXPERIMENTS = [(command, name) for command in COMMANDS for name in listed(command)["experiment"]]


@pytest.fixture(autouse=True)
def hydra_as_it_was() -> Iterator[None]:
    with as_it_was():
        yield


def plain(node: DictConfig) -> dict[str, Any]:
    return {str(key): None if OmegaConf.is_missing(node, key) else node[key] for key in node}


def leaves(node: type, prefix: str = "") -> Iterator[str]:
    """Dotted names of the options of a schema."""
    for item in fields(node):
        factory = item.default_factory
        if factory is not REQUIRED and is_dataclass(factory):
            yield from leaves(factory, f"{prefix}{item.name}.")  # type: ignore[arg-type]
        else:
            yield f"{prefix}{item.name}"


# -- composing ------------------------------------------------------------------------------------


def test_the_groups_hold_what_is_promised():
    assert {"carmen", "scan_folder", "pcd_viewpoint", "depth_frames", "octomap_log", "mesh"} <= set(
        choices("dataset")
    )
    assert {"synthetic_building", "synthetic_building_2d"} <= set(choices("dataset"))
    assert set(choices("map")) == set(MAPS)
    assert {"fig2_1_initialization", "sensor_model", "strategies"} <= set(choices("experiment"))


@pytest.mark.parametrize("dataset", choices("dataset"))
@pytest.mark.parametrize("command", COMMANDS)
def test_every_data_set_composes_and_its_reader_takes_its_options(command, dataset, tmp_path):
    config = composed(command, f"dataset={dataset}").dataset
    assert config.name == dataset
    if "path" not in list(config):  # `in` alone does not see what has no value yet
        assert len(common.open_dataset(config)) > 1
        return
    assert OmegaConf.is_missing(config, "path")
    with pytest.raises(InvalidArgumentError, match=r"dataset\.path is not set"):
        common.open_dataset(config)
    config.path = str(tmp_path / "nowhere")
    with pytest.raises(MissingDataError, match=r"nowhere does not exist; looked for"):
        common.open_dataset(config)


@pytest.mark.parametrize(("command", "name"), EXPERIMENTS)
def test_every_experiment_composes_and_what_it_asks_for_is_there(command, name):
    config = composed(command, f"experiment={name}")
    assert not OmegaConf.missing_keys(config)
    assert composed(command, f"experiment={name}", "seed=77").seed == 77
    if config.study is None:
        known = METHODS if command == "fit" else contenders.methods(GaussianMap)
        assert set(config.method) <= set(known)
        return
    if command == "fit":
        study = studies.STUDIES[config.study.name]
        assert callable(importlib.import_module(f"gmmtorch.report.studies.{study.report}").figures)
    else:
        assert callable(occupancy_studies.STUDIES[config.study.name])
    with pytest.raises(ConfigCompositionException, match="nonsense"):
        composed(command, f"experiment={name}", "study.nonsense=1")


@pytest.mark.parametrize("name", listed("explore")["experiment"])
def test_every_experiment_of_teams_composes_and_its_missions_can_be_flown(name, tmp_path):
    config = composed("explore", f"experiment={name}", "duration=4")
    assert config.duration == 4
    assert not OmegaConf.missing_keys(config)
    variants = missions.variants_of(config)
    assert set(plain(config.study)) == {item.name for item in fields(schema.TrialsStudy)}
    trials = [missions.trial_of(config, tmp_path, variant, 7) for variant in variants]
    assert len({trial.folder for trial in trials}) == len(trials) > 1
    for trial, variant in zip(trials, variants, strict=True):
        named = {"team": trial.team.framework, "seed": trial.team.seed, **vars(trial.team)}
        cuts = [cut._asdict() for cut in trial.team.partitions]
        named["partitions"] = [{**cut, "groups": list(map(list, cut["groups"]))} for cut in cuts]
        assert named["seed"] == 7
        assert {key: named[key] for key in variant} == variant
    with pytest.raises(ConfigCompositionException, match="nonsense"):
        composed("explore", f"experiment={name}", "study.nonsense=1")


@pytest.mark.parametrize("world", choices("world"))
@pytest.mark.parametrize("team", choices("team"))
@pytest.mark.parametrize("planner", choices("planner"))
def test_any_team_and_planner_go_with_any_world(world, team, planner, tmp_path):
    path = ["world.path=mine.ply"] if world == "mesh" else []
    config = composed("explore", f"world={world}", f"team={team}", f"planner={planner}", *path)
    trial = missions.trial_of(config, tmp_path)
    assert (trial.world.name, trial.team.framework, trial.team.planner) == (world, team, planner)
    assert trial.world.path == ("mine.ply" if path else None)


@pytest.mark.parametrize(
    "world",
    [
        "warehouse",
        "tunnels",
    ],
)
def test_a_world_can_be_as_large_as_its_file_says(world):
    options = composed("explore", f"world={world}").world
    draw = {"warehouse": warehouse, "tunnels": tunnels}[world]
    assert draw(options.seed, tuple(options.size)).shape[1:] == (3, 3)


def test_every_team_and_planner_has_its_file():
    assert choices("team") == sorted(FRAMEWORKS)
    assert choices("planner") == sorted(PLANNERS)


def test_every_study_has_an_experiment_that_shows_all_its_options():
    shown = {}
    for command, name in EXPERIMENTS:
        config = composed(command, f"experiment={name}")
        if config.study is not None:
            text = (CONF / "experiment" / f"{name}.yaml").read_text(encoding="utf-8")
            listing = text.split("\nstudy:")[1]
            shown[config.study.name] = set(re.findall(r"^  (\w+):", listing, re.MULTILINE))
    assert shown.keys() == STUDIES.keys() == {*studies.STUDIES, *occupancy_studies.STUDIES}
    for name, options in STUDIES.items():
        assert shown[name] == {item.name for item in fields(options)} - {"name"}, name


@pytest.mark.parametrize("dataset", choices("dataset"))
@pytest.mark.parametrize(
    ("command", "name"), [("fit", "strategies"), ("occupancy", "fig3_6_auc_sparsity_3d")]
)
def test_an_experiment_runs_on_any_data_set(command, name, dataset):
    config = composed(command, f"experiment={name}", f"dataset={dataset}")
    assert config.dataset.name == dataset
    assert len(config.method) > 1


@pytest.mark.parametrize("name", MAPS)
def test_every_map_composes_under_its_name(name):
    config = composed("occupancy", f"map={name}", "map.noise=0.02").map
    assert config.name == name
    assert config.noise == 0.02
    assert set(config) == {item.name for item in fields(MAPS[name][0])}


@pytest.mark.parametrize("name", choices("dataset"))
def test_missing_readings_mean_the_same_with_and_without_a_configuration(name, tmp_path):
    """The values in conf/ are those that the library takes when it is called without options."""
    config = plain(composed("occupancy", f"dataset={name}").dataset)
    source = datasets._SOURCES[name]
    assert config["no_return_range"] == source.no_return_range
    assert config["max_range"] == source.max_range
    assert config["stride"] == 1


@pytest.mark.parametrize("command", CONFIGURED)
def test_nothing_is_missing_from_the_default_configuration(command):
    assert not OmegaConf.missing_keys(composed(command))


@pytest.mark.parametrize("command", CONFIGURED)
def test_results_go_to_outputs_unless_told_otherwise(command):
    schema.register()
    with initialize_config_dir(version_base="1.3", config_dir=str(CONF)):
        node = compose(command, return_hydra_config=True, overrides=["hydra.job.num=3"]).hydra
        assert node.job.name == command
        assert node.job.chdir is False
        # Robots may start in the same second.
        number = "_robot-0" if command == "robot" else ""
        for place in (node.run.dir, node.sweep.dir):
            assert re.fullmatch(rf"outputs/{command}/[-_\d]{{19}}({number})?", place)
        assert node.run.dir.endswith(number)
        assert node.sweep.subdir == f"3{number}"


@pytest.mark.parametrize(
    "override",
    [
        "evaluation.test_every=often",
        "evaluation.kept=0.5",
        "evaluation.resolution=[fine]",
        "map.noise=loud",
        "dataset.stride=two",
        "method=monte_carlo",
        "runtime.threads=many",
        "evaluation.tests_every=3",
        "map.windw=3",
        "dataset.n_scan=3",
        "map=nonsense",
    ],
)
def test_wrong_types_and_names_are_refused_and_named(override):
    name = override.split("=")[0]
    with pytest.raises(ConfigCompositionException, match=name.split(".")[-1]):
        composed("occupancy", override)


# -- one truth about defaults ---------------------------------------------------------------------


def test_the_protocol_takes_what_the_options_offer_with_the_same_defaults():
    ours, theirs = asdict(schema.Evaluation()), asdict(Protocol())
    assert {k: tuple(v) if isinstance(v, list) else v for k, v in ours.items()} == theirs
    assert dict(plain(composed("occupancy").evaluation)) == ours


@pytest.mark.parametrize("name", MAPS)
def test_a_map_takes_what_the_options_offer_with_the_same_defaults(name):
    options = plain(composed("occupancy", f"map={name}").map)
    assert options.pop("name") == name
    rule = asdict(MAPS[name][1])
    assert rule.pop("dtype", "float32") == schema.Runtime().dtype
    for option, value in rule.items():
        assert options.pop(option) == value, option
    made = GaussianMap()
    assert options.pop("codec") == made.codec
    for option in ("n_samples", "sampling", "prior"):
        assert options.pop(option) == getattr(made.query_options, option), option
    # The commands ask for maps that are right at ½, the library for counts: see docs/commands.md.
    assert options == {"cutoff": None, "hit_length": 1}
    assert (made.query_options.cutoff, made.query_options.hit_length) == (5, None)
    limits = {"random_state", "memory_limit", "compiled"}  # which are runtime.* and the seed
    assert {item.name for item in fields(QueryOptions)} == limits | {
        "prior",
        "cutoff",
        "hit_length",
        "n_samples",
        "sampling",
    }


@pytest.mark.parametrize("name", MAPS)
def test_a_map_s_file_repeats_the_defaults_of_the_schema(name):
    ours = plain(composed("occupancy", f"map={name}").map)
    changed = {"window": 1, "max_origins": 1} if name == "per_scan" else {}
    assert ours == {**asdict(MAPS[name][0]()), **changed, "name": name}


def test_the_mixture_takes_what_the_options_offer_with_the_same_defaults():
    ours, theirs = asdict(schema.Mixture()), asdict(FitOptions())
    runtime = schema.Runtime()
    assert theirs == {**ours, "dtype": runtime.dtype, "compiled": runtime.compile}
    assert plain(composed("fit").mixture) == ours


@pytest.mark.parametrize(
    ("experiment", "options", "more"),
    [
        ("fig2_1_initialization", initialization_study.Options, ()),
        ("sensor_model", sensor_noise.NoiseStudy, ("sensor", "sensor_options")),
        ("automatic_components", component_count.CountStudy, ()),
        ("fig3_3_approximation_error", approximation_error.Options, ()),
        ("fig3_8_variance_threshold", variance_threshold.ThresholdStudy, ("method",)),
    ],
)
def test_a_study_takes_what_the_options_offer_with_the_same_defaults(experiment, options, more):
    command = {name: command for command, name in EXPERIMENTS}[experiment]
    ours = plain(composed(command, f"experiment={experiment}").study)
    for name in ("name", *more):
        del ours[name]
    assert ours == {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(options()).items()}


def test_a_team_takes_what_the_options_offer_with_the_same_defaults(tmp_path):
    trial = missions.trial_of(composed("explore"), tmp_path)
    assert trial.team == TeamOptions()
    assert trial.world == WorldOptions(size=(50.0, 40.0, 8.0))


@pytest.mark.parametrize(
    ("choice", "options"),
    [
        ("world=warehouse", schema.GeneratedWorld),
        *((f"team={name}", schema.Team) for name in choices("team")),
        ("planner=mcts", schema.TreePlannerOptions),
        ("planner=frontier", schema.PlannerOptions),
        ("planner=random", schema.PlannerOptions),
    ],
)
def test_the_files_of_a_team_repeat_the_defaults_of_the_schema(choice, options):
    group, name = choice.split("=")
    assert plain(composed("explore", choice)[group]) == {**asdict(options()), "name": name}


@pytest.mark.parametrize(("command", "options"), [("explore", schema.Explore), ("robot", schema.Robot)])
def test_the_file_of_robots_repeats_the_defaults_of_the_schema(command, options):
    config = composed(command)
    defaults = asdict(options())
    for group in ("world", "team", "planner"):
        del defaults[group]
    if "log" in defaults:
        del defaults["log"]["map"], config.log.map
    for name, value in defaults.items():
        assert OmegaConf.to_container(OmegaConf.create({name: config[name]}))[name] == value, name


def test_robots_of_their_own_are_those_that_explore():
    ours, theirs = asdict(schema.Robot()), asdict(schema.Explore())
    del ours["runtime"]["memory_limit"]  # of a replayed log's map
    for name in ("report", "evaluation", "network", "runtime"):
        assert ours[name].items() <= theirs[name].items()
    different = {"transport", "report", "evaluation", "network", "runtime"}
    assert all(ours[name] == theirs[name] for name in (ours.keys() & theirs.keys()) - different)


def test_a_team_is_of_robots_in_all_but_its_clock():
    robot, team = OmegaConf.to_container(composed("robot")), OmegaConf.to_container(composed("team"))
    assert team == {**robot, "clock": None}


@pytest.mark.parametrize("command", COMMANDS)
def test_the_files_repeat_the_defaults_of_the_schema(command):
    config = composed(command)
    report = schema.Fit().report if command == "fit" else schema.Occupancy().report
    assert plain(config.report) == asdict(report)
    assert plain(config.runtime) == asdict(schema.Runtime())


# -- files ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [schema.Occupancy, schema.Fit, schema.Explore, schema.Robot])
def test_the_configuration_file_shows_every_option(options):
    """So that --help, which prints the composed file, and the file itself say the same."""
    text = (CONF / f"{options.__name__.lower()}.yaml").read_text(encoding="utf-8")
    for name in leaves(options):
        elsewhere = ("dataset", "world", "team", "planner", "log.dataset")
        elsewhere += () if options in (schema.Explore, schema.Robot) else ("map.",)
        if not name.startswith(elsewhere):
            assert re.search(rf"^ *{name.split('.')[-1]}:", text, re.MULTILINE), name


# -- where conf/ is -------------------------------------------------------------------------------


def pretend_package(root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    package = root / "gmmtorch"
    (package / "cli").mkdir(parents=True)
    monkeypatch.setattr(common, "__file__", str(package / "cli" / "common.py"))
    return package


def put_conf(folder: Path) -> Path:
    (folder / "conf").mkdir()
    (folder / "conf" / "occupancy.yaml").touch()
    return folder / "conf"


def test_conf_is_looked_up_in_the_package_first_and_then_beside_it(tmp_path, monkeypatch):
    package = pretend_package(tmp_path, monkeypatch)
    beside = put_conf(tmp_path)
    assert common.conf_dir() == str(beside)
    inside = put_conf(package)
    assert common.conf_dir() == str(inside)


def test_a_folder_that_is_only_called_conf_is_not_taken_for_it(tmp_path, monkeypatch):
    package = pretend_package(tmp_path, monkeypatch)
    (package / "conf").mkdir()
    beside = put_conf(tmp_path)
    assert common.conf_dir() == str(beside)


def test_a_missing_conf_says_where_it_was_looked_for(tmp_path, monkeypatch):
    package = pretend_package(tmp_path, monkeypatch)
    with pytest.raises(FileNotFoundError, match=re.escape(str(package))) as caught:
        common.conf_dir()
    assert "install gmmtorch again" in str(caught.value)


# -- answering at once ----------------------------------------------------------------------------

_HEAVY = {"torch", "numpy", "scipy", "sklearn", "matplotlib", "open3d", "safetensors", "tensorboard"}
_THEN_LIST_MODULES = """
import sys
from gmmtorch.cli.{command} import main
sys.argv = ["gmmtorch-{command}", *{arguments}]
try:
    main()
finally:
    sys.stdout.flush()
    print(*sys.modules, file=sys.stderr)
"""


@pytest.mark.parametrize("command", CONFIGURED)
@pytest.mark.parametrize("arguments", [["--help"], ["--cfg", "job"]], ids=" ".join)
def test_help_and_configuration_are_shown_without_loading_anything_heavy(command, arguments, tmp_path):
    code = _THEN_LIST_MODULES.format(command=command, arguments=arguments)
    done = run_python(["-c", code], cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    modules = set(done.stderr.split())
    assert {"hydra", "gmmtorch.cli.common"} <= modules
    assert not _HEAVY & modules
    assert not list(tmp_path.iterdir())  # nothing was run
    if arguments == ["--help"]:
        assert f"gmmtorch-{command}" in done.stdout
        assert "Examples:" in done.stdout
        for group in {"dataset", "world", "team", "planner"} & listed(command).keys():
            assert all(choice in done.stdout for choice in choices(group))
    else:
        shown = OmegaConf.to_container(OmegaConf.create(done.stdout))
        assert shown == OmegaConf.to_container(composed(command))


def test_the_examples_of_the_help_compose():
    for command in CONFIGURED:
        text = (CONF / f"{command}.yaml").read_text(encoding="utf-8").replace("\\\n", " ")
        examples = re.findall(rf"^ +gmmtorch-{command}\b(.*)$", text, re.MULTILINE)
        assert len(examples) >= 5
        for example in examples:
            words = shlex.split(example.split("(shows")[0])
            overrides = [word for word in words if not word.startswith("-") and word != "job"]
            if "-m" in words:  # of a sweep, the first value of each
                overrides = [re.sub(r"=([^,\[]*),.*", r"=\1", word) for word in overrides]
            composed(command, *overrides)


def test_the_commands_are_installed_under_their_names():
    scripts = {point.name: point.value for point in entry_points(group="console_scripts")}
    for command in CONFIGURED:
        assert scripts[f"gmmtorch-{command}"] == f"gmmtorch.cli.{command}:main"


def test_help_names_every_choice_of_every_group():
    """Each experiment is named by the command that it is for, and by that alone."""
    of_occupancy, of_fit, of_explore, *of_robots = map(listed, CONFIGURED)
    assert of_occupancy.keys() == {"dataset", "map", "experiment"}
    assert of_fit.keys() == {"dataset", "experiment"}
    for groups in (of_occupancy, of_fit):
        assert sorted(groups["dataset"]) == choices("dataset")
    assert sorted(of_occupancy["map"]) == choices("map")
    assert of_explore.keys() == {"world", "team", "planner", "experiment"}
    for group in ("world", "team", "planner"):
        assert sorted(of_explore[group]) == choices(group)
        assert all(of_robot[group] == of_explore[group] for of_robot in of_robots)
    named = [name for groups in (of_occupancy, of_fit, of_explore) for name in groups["experiment"]]
    assert sorted(named) == choices("experiment")
