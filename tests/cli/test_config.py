"""Every configuration composes, repeats the library's defaults, and is shown quickly."""

from __future__ import annotations

import os
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from importlib.metadata import entry_points
from pathlib import Path

import pytest
from command_runs import CHECKOUT, COMMANDS, CONF, as_it_was, composed, register_schemas, run_python
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from gmmtorch import GaussianMap, IncrementalRule, NoveltyRule, WindowedRule, datasets
from gmmtorch.cli import build, common, export, inputs, localize, open_dataset, options_help
from gmmtorch.errors import InvalidArgumentError, MissingDataError
from gmmtorch.experiments.cli import studies as study_cases
from gmmtorch.experiments.cli.experiment_schema import STUDIES
from gmmtorch.experiments.cli.fit_runs import fit_options
from gmmtorch.experiments.evaluation import methods
from gmmtorch.experiments.evaluation.fits import ESTIMATORS
from gmmtorch.team.cli import from_options
from gmmtorch.team.exploration.mission.options import FRAMEWORKS, THESIS, TeamOptions
from gmmtorch.team.exploration.mission.trials import WorldOptions
from gmmtorch.team.exploration.planning.planners import PLANNERS

SCORED = ["occupancy", "fit"]
CONFIGURED = [*SCORED, "map", "explore", "robot", "team", "export", "view", "ros", "localize"]
MAPS = {
    "incremental": IncrementalRule(),
    "per_scan": WindowedRule(window=1, max_origins=1),
    "windowed": WindowedRule(),
}


def choices(group: str) -> list[str]:
    return sorted(path.stem for path in (CONF / group).glob("*.yaml"))


EXPERIMENTS = [
    (command, name) for command in SCORED for name in options_help.groups_of(command)["experiment"]
]


@pytest.fixture(autouse=True)
def hydra_as_it_was() -> Iterator[None]:
    with as_it_was():
        yield


# -- composition ----------------------------------------------------------------------------------


@pytest.mark.parametrize("dataset", choices("dataset"))
def test_every_data_set_composes_and_its_reader_takes_its_options(dataset, tmp_path):
    config = composed("fit", f"dataset={dataset}").dataset
    source = datasets.OPTIONS[dataset]
    assert (config.name, config.get("stride", 1)) == (dataset, 1)
    assert (config.no_return_range, config.max_range) == (source.no_return_range, source.max_range)
    if "path" not in list(config):  # `in` is False for a missing value
        assert len(open_dataset(config)) > 1
        return
    assert OmegaConf.is_missing(config, "path")
    with pytest.raises(InvalidArgumentError, match=r"dataset\.path is not set"):
        open_dataset(config)
    config.path = str(tmp_path / "nowhere")
    with pytest.raises(MissingDataError, match=r"nowhere does not exist; looked for"):
        open_dataset(config)


@pytest.mark.parametrize(("command", "name"), EXPERIMENTS)
def test_every_experiment_composes_and_its_methods_and_study_exist(command, name):
    config = composed(command, f"experiment={name}", "seed=77")
    assert config.seed == 77
    assert not OmegaConf.missing_keys(config)
    if config.study is None:
        known = ESTIMATORS if command == "fit" else methods(GaussianMap)
        assert set(config.method) <= set(known)
        return
    studies = study_cases.STUDIES[command]
    assert config.study.name in studies
    with pytest.raises(ConfigCompositionException, match="nonsense"):
        composed(command, f"experiment={name}", "study.nonsense=1")


def test_every_study_has_an_experiment():
    configs = [composed(command, f"experiment={name}") for command, name in EXPERIMENTS]
    assert {config.study.name for config in configs if config.study is not None} == STUDIES.keys()
    assert STUDIES.keys() == {name for cases in study_cases.STUDIES.values() for name in cases}


@pytest.mark.parametrize("name", options_help.groups_of("explore")["experiment"])
def test_every_experiment_of_teams_composes_and_gives_its_trials(name, tmp_path):
    config = composed("explore", f"experiment={name}", "duration=4")
    assert config.duration == 4
    assert not OmegaConf.missing_keys(config)
    variants = from_options.variants_of(config)
    trials = [from_options.trial_of(config, tmp_path, variant, 7) for variant in variants]
    assert len({trial.folder for trial in trials}) == len(trials) > 1
    for trial, variant in zip(trials, variants, strict=True):
        named = {"team": trial.team.framework, **vars(trial.team), **trial.team.learning}
        cuts = [cut._asdict() for cut in trial.team.partitions]
        named["partitions"] = [{**cut, "groups": list(map(list, cut["groups"]))} for cut in cuts]
        assert named["seed"] == 7
        assert {key: named[key] for key in variant} == variant
    with pytest.raises(ConfigCompositionException, match="nonsense"):
        composed("explore", f"experiment={name}", "study.nonsense=1")


def test_the_file_of_the_thesis_team_has_its_options():
    plain = from_options.team_options(composed("explore"), 0, {"team": "gmm_thesis"})
    assert plain.codec == THESIS["codec"]
    assert from_options.team_options(composed("explore", "team=gmm_thesis"), 0, {}) == plain


def test_options_that_are_not_of_the_thesis_team_are_refused():
    with pytest.raises(InvalidArgumentError, match=r"team=gmm_thesis with codec=float.* has thesis"):
        from_options.team_options(composed("explore", "team=gmm_thesis"), 0, {"codec": "float"})
    with pytest.raises(InvalidArgumentError, match="team=gmm_thesis sets options of all teams"):
        from_options.variants_of(composed("explore", "team=gmm_thesis", "experiment=deviations"))


def test_every_team_and_planner_has_its_file():
    assert choices("team") == sorted(FRAMEWORKS)
    assert choices("planner") == sorted(PLANNERS)


@pytest.mark.parametrize("command", CONFIGURED[: CONFIGURED.index("export")])
def test_results_go_to_a_folder_in_outputs(command):
    register_schemas()
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


# -- one set of defaults --------------------------------------------------------------------------


def test_files_in_conf_have_no_value_that_is_the_default():
    """An option is told once: a file has what differs from the declarations, and choices."""
    for command in CONFIGURED:
        given = OmegaConf.load(CONF / f"{command}.yaml")
        assert set(given) == {"defaults", "hydra"}, command
    for name in choices("dataset"):
        assert set(OmegaConf.load(CONF / "dataset" / f"{name}.yaml")) == {"defaults", "name"}


@pytest.mark.parametrize("name", MAPS)
def test_a_map_of_the_options_has_the_default_rule_and_answers(name):
    config = composed("occupancy", f"map={name}")
    assert config.map.name == name
    made = inputs.map_factory(config)()
    assert made.learning == MAPS[name]


@pytest.mark.parametrize(
    ("name", "more", "expected"),
    [
        ("per_scan", "seed=7", {"window": 1, "max_origins": 1, "dtype": "float64"}),
        ("windowed", "map.window=5", {"window": 5, "max_origins": 8}),
        ("incremental", "map.window=3 map.n_components=30", {"window": 3, "n_components": 30}),
        ("incremental", "map.novelty={threshold:2}", {"novelty": NoveltyRule(threshold=2)}),
    ],
)
def test_the_map_has_the_options_of_its_group(name, more, expected):
    options = ["map.noise=0.02", "map.prior=0.5", "runtime.dtype=float64", "seed=7"]
    options += ["map.n_samples=1000"]
    made = inputs.map_factory(composed("occupancy", f"map={name}", *more.split(), *options))()
    assert made.learning.noise == 0.02
    assert {option: getattr(made.learning, option) for option in expected} == expected
    how = made.query_options
    assert (how.n_samples, how.prior, how.random_state) == (1000, 0.5, 7)


def test_explorations_fits_and_protocols_of_the_options_are_the_default_ones(tmp_path):
    trial = from_options.trial_of(composed("explore"), tmp_path)
    assert trial.team == TeamOptions()
    assert trial.world == WorldOptions(size=(50.0, 40.0, 8.0))
    from gmmtorch.experiments.evaluation.protocol_options import FitOptions, Protocol

    assert fit_options(composed("fit")) == FitOptions()
    assert build(Protocol, composed("occupancy"), "evaluation") == Protocol()


def test_robots_and_teams_have_the_options_of_an_exploration():
    explore, robot, team = (OmegaConf.to_container(composed(name)) for name in ("explore", "robot", "team"))
    assert team == robot
    del robot["runtime"]["memory_limit"]  # of the map of a replayed log
    for name in ("report", "evaluation", "network", "runtime"):
        assert robot[name].items() <= explore[name].items()
    different = {"transport", "report", "evaluation", "network", "runtime"}
    assert all(robot[name] == explore[name] for name in (robot.keys() & explore.keys()) - different)


# -- the folder conf/ -----------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty package in a temporary folder, in which `conf_dir` searches."""
    folder = tmp_path / "gmmtorch"
    (folder / "cli").mkdir(parents=True)
    monkeypatch.setattr(common, "__file__", str(folder / "cli" / "common.py"))
    return folder


def put_conf(folder: Path) -> Path:
    (folder / "conf").mkdir(exist_ok=True)
    (folder / "conf" / "occupancy.yaml").touch()
    return folder / "conf"


def test_conf_is_found_in_the_package_first_and_then_beside_it(tmp_path, package):
    (package / "conf").mkdir()  # a folder without configurations is ignored
    beside = put_conf(tmp_path)
    assert common.conf_dir() == str(beside)
    inside = put_conf(package)
    assert common.conf_dir() == str(inside)


def test_a_missing_conf_raises_and_names_the_searched_folder(package):
    with pytest.raises(FileNotFoundError, match=re.escape(str(package))) as caught:
        common.conf_dir()
    assert "install gmmtorch again" in str(caught.value)


# -- help -----------------------------------------------------------------------------------------

_HEAVY = {"torch", "numpy", "scipy", "sklearn", "matplotlib", "open3d", "safetensors", "tensorboard", "PIL"}
_SHOW_ALL = """
import importlib, sys
from hydra.core.global_hydra import GlobalHydra
for command, module in {commands}.items():
    sys.argv = ["gmmtorch-" + command, *{arguments}]
    print("=====", command)
    try:
        importlib.import_module(module).main()
    except SystemExit as end:
        assert not end.code, end.code
    GlobalHydra.instance().clear()
print("=====")
sys.stdout.flush()
print(*sys.modules, file=sys.stderr)
"""


def shown_by(commands: list[str], *arguments: str, cwd: Path) -> dict[str, str]:
    """Standard output of each command in one new process, which must import nothing heavy."""
    done = run_python(
        [
            "-c",
            _SHOW_ALL.format(
                commands={name: COMMANDS[name].__name__ for name in commands}, arguments=list(arguments)
            ),
        ],
        cwd=cwd,
    )
    assert done.returncode == 0, done.stderr
    modules = set(done.stderr.split())
    assert {"hydra", "gmmtorch.cli.common"} <= modules
    assert not _HEAVY & modules
    assert not list(cwd.iterdir())  # nothing was run
    return dict(re.findall(r"^===== (\w+)\n((?:(?!=====).*\n)*)", done.stdout, re.MULTILINE))


def test_configuration_is_shown_without_heavy_imports(tmp_path):
    for command, shown in shown_by(CONFIGURED, "--cfg", "job", cwd=tmp_path).items():
        configuration = OmegaConf.to_container(OmegaConf.create(shown))
        assert configuration == OmegaConf.to_container(composed(command))


_REFUSE = """
import importlib, sys
from hydra.core.global_hydra import GlobalHydra
for command, module, *arguments in {runs}:
    sys.argv = ["gmmtorch-" + command, *arguments, "hydra.run.dir=run"]
    try:
        importlib.import_module(module).main()
    except SystemExit as end:
        print(end.code)
    GlobalHydra.instance().clear()
print(*sys.modules, file=sys.stderr)
"""


def test_inputs_that_do_not_exist_are_refused_without_heavy_imports(tmp_path):
    runs = [
        ("fit", "points=none.ply"),
        ("fit", "points=none.doc"),
        ("view", "none"),
        ("export", "path=none", "output=a.ply"),
        ("export", "path=.", "output=a.doc"),
        ("localize", "map=none"),
        ("explore", "world=mesh", "world.path=none.ply"),
    ]
    done = run_python(
        ["-c", _REFUSE.format(runs=[(run[0], COMMANDS[run[0]].__name__, *run[1:]) for run in runs])],
        cwd=tmp_path,
    )
    assert not _HEAVY & set(done.stderr.split())
    options = ("points", "points", "path", "path", "output", "map.path", "world.path")
    for option, line in zip(options, done.stdout.splitlines(), strict=True):
        assert line.startswith(f"gmmtorch: error: {option}=")


_RUN = """
import importlib, io, sys

class Output(io.StringIO):
    def write(self, text):
        if not self.getvalue():
            loaded.append(set(sys.modules))
        return super().write(text)

loaded, out = [], sys.stdout
sys.stdout = Output()
sys.argv = ["gmmtorch"] + {arguments}
importlib.import_module({module!r}).main()
print(sys.stdout.getvalue(), *loaded[0], file=out, flush=True)  # at exit only sys.stdout is flushed
print(*sys.modules, file=sys.stderr)
"""
_UNUSED = {
    "fit": {"gmmtorch.team", "gmmtorch.localization.odometry", "sklearn.mixture"},
    "map": {"gmmtorch.team", "gmmtorch.localization.odometry", "sklearn", "scipy.stats"},
}
"""Modules that a plain run of a command does not need, besides those of pictures, TensorBoard and Open3D."""


@pytest.mark.slow
@pytest.mark.parametrize("command", _UNUSED)
def test_a_command_prints_a_line_before_heavy_imports_and_loads_what_it_uses(command, tmp_path):
    options = ["dataset=synthetic_building_2d", "dataset.n_scans=5", f"hydra.run.dir={tmp_path / 'run'}"]
    options += ["mixture.n_components=3"] * (command == "fit")
    quiet = [f"report.{name}=false" for name in ("progress", "figures", "tensorboard")]
    for more, pictures in (([], True), (quiet, False)):
        code = _RUN.format(arguments=options + more, module=COMMANDS[command].__name__)
        done = run_python(["-c", code], cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        line, *_, first = done.stdout.splitlines()
        assert line == f"gmmtorch-{command} writes to {tmp_path / 'run'}"
        assert not _HEAVY & set(first.split())
        loaded = set(done.stderr.splitlines()[-1].split())
        assert not (_UNUSED[command] | {"open3d", "matplotlib.pyplot"}) & loaded
        assert bool({"matplotlib", "tensorboard"} & loaded) == pictures
        assert "torch" in loaded


@pytest.mark.parametrize(
    "commands", [["export"], pytest.param(["occupancy", "explore", "robot"], marks=pytest.mark.slow)]
)
def test_help_is_shown_without_heavy_imports(commands, tmp_path):
    found = shown_by(commands, "--help", cwd=tmp_path)
    assert list(found) == commands
    for command, shown in found.items():
        assert f"gmmtorch-{command}" in shown
        assert "Examples:" in shown
        for group in {"dataset", "world", "team", "planner"} & options_help.groups_of(command).keys():
            assert all(choice in shown for choice in choices(group))
    formats = (*export._OF_SPACE, *export._OF_COMPONENTS) if "export" in found else ()
    assert all(name in found["export"] for name in formats)


@pytest.mark.parametrize("command", CONFIGURED)
def test_the_examples_of_the_help_compose(command):
    text = (CONF / f"{command}.yaml").read_text(encoding="utf-8").replace("\\\n", " ")
    examples = re.findall(rf"^ +gmmtorch-{command}\b(.*)$", text, re.MULTILINE)
    assert len(examples) >= 5
    for example in examples:
        words = shlex.split(example.split("(shows")[0])
        overrides = [word for word in words if not word.startswith("-") and word != "job"]
        if "-m" in words:  # of a sweep, the first value of each
            overrides = [re.sub(r"=([^,\[]*),.*", r"=\1", word) for word in overrides]
        composed(command, *(localize.overrides(overrides) if command == "localize" else overrides))


def test_help_names_every_choice_of_every_group():
    """Each experiment is named by the command that runs it, and by no other."""
    of_occupancy, of_fit, of_map, of_explore, *of_robots = map(
        options_help.groups_of, CONFIGURED[: CONFIGURED.index("export")]
    )
    assert of_occupancy.keys() == {"dataset", "map", "experiment"}
    assert of_fit.keys() == {"dataset", "experiment"}
    assert of_map.keys() == {"dataset", "map"}
    assert of_map["map"] == of_occupancy["map"]
    for groups in (of_occupancy, of_fit, of_map):
        assert sorted(groups["dataset"]) == choices("dataset")
    assert sorted(of_occupancy["map"]) == choices("map") == sorted(MAPS)
    assert of_explore.keys() == {"world", "team", "planner", "experiment"}
    for group in ("world", "team", "planner"):
        assert sorted(of_explore[group]) == choices(group)
        assert all(of_robot[group] == of_explore[group] for of_robot in of_robots)
    named = [name for groups in (of_occupancy, of_fit, of_explore) for name in groups["experiment"]]
    assert sorted(named) == choices("experiment")


# -- commands and scripts -------------------------------------------------------------------------


@pytest.mark.parametrize("command", CONFIGURED)
def test_every_command_is_installed_and_has_a_script(command, monkeypatch):
    entries = {point.name: point.value for point in entry_points(group="console_scripts")}
    assert entries[f"gmmtorch-{command}"] == f"{COMMANDS[command].__name__}:main"
    script = CHECKOUT / "scripts" / f"{command}.py"
    assert script.read_text(encoding="utf-8").startswith("#!")
    assert os.access(script, os.X_OK)
    monkeypatch.setattr(sys, "path", list(sys.path))
    names = runpy.run_path(str(script), run_name="__mp_main__")  # as a worker process imports it
    assert callable(names["main"])
