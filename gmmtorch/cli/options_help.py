"""What a command can run: its options, with a line on each, and the choices of its groups.

The lines come from the dataclasses that make the schema. `--help`, completion, the errors for mistyped
options and the tables of docs/commands.md use this file. It composes configurations, and imports nothing
heavy.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Collection, Iterator, Sequence
from difflib import SequenceMatcher
from importlib.util import find_spec
from pathlib import Path
from string import Template
from typing import Any, NamedTuple

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli import common
from gmmtorch.cli.schema import about_of
from gmmtorch.errors import InvalidArgumentError

_NEAR = 0.6
"""Least similarity of a name to the name that is proposed for it."""
_CONSTANT = "it is a constant; in Python, %s."
_LOG_MAP = "give options of the map as in 'log.map={name: windowed, window: 20}'."
_REPLACED = {
    "map.hit_length": "map.prior=1 gives the probabilities of counts; without it they are calibrated.",
    "map.bounds": "give bounds=[…].",
    "view_host": "use host.",
    "view_port": "use port.",
    "view_origins": "use origins.",
    "map.codec": "files have quantized components; in Python, GaussianMap(codec='float') has exact numbers.",
    "n_points": "in Python, Tracker and read_gira_csv have it.",
    "align": "the truth is in the frame of the map; in Python, absolute_trajectory_error aligns both.",
    "free_thresh": "cells below 0.196 are free; map_server's YAML file can state another free_thresh.",
    "trajectory": "trajectory.tum beside the map is shown; in Python, MapViewer and write_page show others.",
    "tile_bytes": "in Python, gmmtorch.mapping.merge has it.",
    "map.cutoff": _CONSTANT % "an argument of `GaussianMap`",
    "map.noise": "map.side is the side (m) of the cells of an octree that is as exact.",
    "map@log.map": _LOG_MAP,
    "log.every": "use log.dataset.stride.",
    "log.part": "each robot replays a consecutive part of the log.",
    "clock": "each robot runs by its own clock; speed=2 is twice real time.",
    "journal.sync": "every store survives a loss of power.",
    "journal.enabled": "every robot stores its map.",
    "link.insecure": "give all robots a key: link.key_file.",
    "link.team": "give each team a key of its own, or set namespace in the file of link.zenoh_config.",
    "link.listen_endpoints": "give link.listen, as in tcp/0.0.0.0:7447.",
    "link.connect_endpoints": "give link.peers, as in [tcp/10.0.0.3:7447].",
    "node.domain": "set the environment variable ROS_DOMAIN_ID.",
    "sensor.camera_info": "the nearest topic by name is used; sensor.intrinsics=[fx,fy,cx,cy] replaces it.",
    "link.scouting": "set scouting in the file of link.zenoh_config.",
    "link.ttl": "robots of a multicast group share one network.",
    "log.rate": "use sensor.rate.",
    "log.start": "use start.",
    "rate": "use speed.",
    "report.magnify": "use report.detail=true.",
    "report.scene": "use report.detail=true.",
    "runtime.workers": "use workers.",
    "study.n_seeds": "use study.seeds, as in [0,1,2].",
    "runtime.cache": "results that depend only on the world are always stored.",
    "stream.checkpoint_seconds": "use checkpoint_seconds.",
    "stream.checkpoint_every": "use checkpoint_seconds; else every ten iterations have one.",
    "stream.max_range": "use dataset.max_range.",
    "stream.sample_points": "the start of EM and PSNR2 take 100,000 points.",
    "stream.timeout": "processes wait for each other for ten minutes.",
    "codec": _CONSTANT
    % "`TeamOptions.codec`, which a variant of a study may set; team=gmm_thesis has its own",
    "rounds": "there are always three.",
    "planner.rest": _CONSTANT % "`TeamOptions.rest`",
    "dataset.damaged": "the intact part of a damaged recording is read, with a warning.",
    "dataset.camera_info": "the topic nearest by name is read; dataset.intrinsics states another camera.",
    "dataset.imu_topic": "of several IMUs, the one with most messages is read.",
    "dataset.noise": _CONSTANT % "an argument of `gmmtorch.datasets.load`",
    "planner.beams": _CONSTANT % "`TeamOptions.n_beams`",
    "planner.prior": _CONSTANT % "`TeamOptions.planning_prior`, which a variant of a study may set",
}
"""Options of earlier versions, and what replaces them."""
_REPLACED_GROUPS = (
    ("", "distance angle", "a first pose may be off by 0.5 m and 0.175 rad; pose=null searches the map."),
    (
        "checkpoint.",
        "every folder",
        "missions have no checkpoints. A study that was killed continues with the missions that are missing "
        "if you run the same command with hydra.run.dir=RUN, the folder of the killed run.",
    ),
    ("belief.", "prior clamp free occupied", _CONSTANT % "`BeliefRule`"),
    (
        "map.",
        "cell iterations length max_cells max_cost max_origins mean_origins planarity min_density_share "
        "min_points min_support sampling window_components components distance distance_for hits_per_ray "
        "novelty_block observed rays shell threshold update_at update_every update_novel update_stride prune "
        "learner free_points",
        _CONSTANT % "a field of the learning rule, of `QueryOptions` or of `FrameRule`; a study may vary it",
    ),
    (
        "mixture.",
        "max_cells min_density_share min_support n_init reg_covar",
        _CONSTANT % "the estimator has it",
    ),
    (
        "robot.",
        "radius speed climb yaw_rate acceleration yaw_acceleration duration step",
        _CONSTANT % "`Dynamics` has it",
    ),
    (
        "sensor.",
        "horizontal_fov vertical_fov max_range noise dropout max_gap deskew",
        _CONSTANT % "`DepthCamera` or `LiveOptions` has it",
    ),
    (
        "study.",
        "bandwidths bgk_points dims forms init_params max_beams max_iter max_origins method methods "
        "multiples n_cells n_large_samples n_neighbors n_pixels n_points n_rays n_samples n_scans noise "
        "others prior railing_scans resolution sensor sensor_options support test_every thin_width tol "
        "tolerance variance_threshold window window_components",
        _CONSTANT % "the class of the study has it",
    ),
)
"""The same for several options: the beginning of their names, the ends, and what replaces them."""
_LAUNCHERS = ("joblib", "ray")
"""Hydra's launchers of the extra [sweep]."""
_GROUPS = "== Configuration groups =="
_LINE = 110
"""Characters of the description of an option, at most, if its first sentence is shorter."""
_VALUES = 34
"""Width of the column of options and values in the help."""


class Option(NamedTuple):
    """An option: its dotted name, its value in the configuration, and what it means."""

    name: str
    value: Any
    about: str


def configuration(command: str, overrides: Sequence[str] = ()) -> DictConfig:
    """The configuration of a command, with the options of Hydra. Raises the errors of Hydra."""
    GlobalHydra.instance().clear()
    with initialize_config_dir(version_base="1.3", config_dir=common.conf_dir()):
        return compose(command, overrides=list(overrides), return_hydra_config=True)


def options_of(config: DictConfig) -> list[Option]:
    """The options of a composed configuration that the command line can set, in its order.

    Without those of Hydra, and the study, which `experiment=` sets.
    """
    found = [option for name in config if name != "hydra" for option in _options(config, str(name), "")]
    return [one for one in found if one.name != "study"]


def _options(node: DictConfig, name: str, prefix: str) -> Iterator[Option]:
    value = None if OmegaConf.is_missing(node, name) else node._get_node(name)
    if isinstance(value, DictConfig) and not value._is_none() and not _is_dict(value):
        for inner in value:
            if inner != "name":  # set by the choice of a group
                yield from _options(value, str(inner), f"{prefix}{name}.")
        return
    about = about_of(node, name).replace("None", "null")
    shown = "???" if OmegaConf.is_missing(node, name) else node[name]
    yield Option(f"{prefix}{name}", shown, about)


def _is_dict(node: DictConfig) -> bool:
    """Whether a node takes any names."""
    return OmegaConf.get_type(node) is dict


def _brief(text: str) -> str:
    """The first sentences of a text that fit a line."""
    kept, *others = re.split(r"(?<=\.) (?=[A-Z])", text)
    for other in others:
        if len(kept) + len(other) > _LINE:
            break
        kept += f" {other}"
    return kept.rstrip(".")


@functools.cache
def groups_of(command: str) -> dict[str, list[str]]:
    """The choices of every group that a command can run, as its help lists them."""
    conf = Path(common.conf_dir())
    text = (conf / f"{command}.yaml").read_text(encoding="utf-8")
    section = text.partition(_GROUPS)[2].partition("== Options")[0]
    parts = re.split(r"(\w+):", section)[1:]
    found = {name: re.findall(r"\w+", names) for name, names in zip(parts[::2], parts[1::2], strict=True)}
    if base := re.search(r"^  - (robot)\b", text, re.MULTILINE):
        text += (conf / f"{base[1]}.yaml").read_text(encoding="utf-8")
    for name, group in re.findall(r"^  - .*?/((\w+)@\S+):", text, re.MULTILINE):  # of a part, as log.dataset
        found[name] = sorted(path.stem for path in (conf / group).glob("*.yaml"))
    return found


def help_text(command: str, overrides: Sequence[str] = ()) -> str:
    """The help of a command: its purpose, examples, groups, and a line on each option."""
    config, lines = configuration(command, overrides), []
    for option in options_of(config):
        head = f"{option.name}={text_of_value(option.value)}"
        lines.append(f"{head:<{_VALUES}}  {_brief(option.about)}".rstrip())
    return Template(config.hydra.help.template).safe_substitute(CONFIG="\n".join(lines))


def text_of_value(value: Any) -> str:
    """A value as the command line takes it."""
    if OmegaConf.is_config(value):
        return re.sub(r"(?<=[,:]) ", "", str(OmegaConf.to_container(value)).replace("'", ""))
    if value is None:
        return "null"
    return str(value).lower() if isinstance(value, bool) else str(value)


def completions(command: str, line: str) -> list[str]:
    """What may follow a command line: choices of groups and names of options that the command can run."""
    words = line.split()
    overrides = [word for word in words[1:] if not word.startswith("-")]
    word = overrides.pop() if overrides and not line.endswith(" ") else ""
    config = _tolerant(command, overrides)
    groups = groups_of(command)
    key, is_set, _ = word.partition("=")
    if is_set:
        found = [f"{key}={choice}" for choice in groups.get(key, [])]
        if isinstance(OmegaConf.select(config, key, throw_on_missing=False), bool):
            found = [f"{key}=true", f"{key}=false"]
    else:
        names = {option.name for option in options_of(config)}
        depth = word.count(".") + 1
        found = [f"{group}=" for group in groups]
        for name in names:
            parts = name.split(".")
            found.append(f"{name}=" if len(parts) <= depth else f"{'.'.join(parts[:depth])}.")
    return sorted({one for one in found if one.startswith(word)})


def _tolerant(command: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration with those overrides that choose from groups; without all that are wrong."""
    kept: list[str] = []
    config = configuration(command)
    for override in overrides:
        if override.partition("=")[0] in groups_of(command):
            try:
                config = configuration(command, [*kept, override])
            except (HydraException, OmegaConfBaseException):
                continue
            kept.append(override)
    return config


def _is_installed(module: str) -> bool:
    """Whether a module of a package exists; the package itself may be missing."""
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of the package
        return False


def explained(command: str, overrides: Sequence[str], error: Exception) -> str:
    """What is wrong with these overrides, which Hydra has refused with an error, in one line."""
    parsed: list[Override] = []
    for text in overrides:
        try:
            parsed.append(OverridesParser.create().parse_override(text))
        except HydraException:
            return (
                f"{text} is not option=value; quote lists and special characters for the shell, as in "
                "'method=[em]'."
            )
    for launcher in _LAUNCHERS:
        chosen = f"hydra/launcher={launcher}"
        if chosen in overrides and not _is_installed(f"hydra_plugins.hydra_{launcher}_launcher"):
            return (
                f"{chosen} needs the package hydra-{launcher}-launcher, which is not installed; install it: "
                "pip install 'gmmtorch[sweep]'."
            )
    config = _tolerant(command, [choice for one in parsed for choice in _choices(one)])
    groups = groups_of(command)
    if wrong := _wrong_choice(parsed, groups):
        return wrong
    names = set(_names(config))
    for one in parsed:
        name = _key(one)
        if "/" in name or name in groups or name in names or _is_free(config, name):
            continue
        if instead := _instead_of(name):
            return f"{name} is no longer an option: {instead}"
        known = [option.name for option in options_of(config)]
        known += [*groups, *_of_other_choices(groups)]
        if name.startswith("hydra"):
            known = list(names)
        group, chosen = name.split(".")[0], ""
        if group in groups and group in config.hydra.runtime.choices:
            chosen = f" with {group}={config.hydra.runtime.choices[group]}"
        hint = f"; another choice of {group}= has it." if name in known else _hint(name, known)
        return f"{name} is not an option of gmmtorch-{command}{chosen}{hint} --help lists all options."
    return _first_lines(error)


def _instead_of(name: str) -> str | None:
    """What replaces an option of an earlier version; None if there was none of this name."""
    for start, ends, text in _REPLACED_GROUPS:
        if name.startswith(start) and name.removeprefix(start) in ends.split():
            return text
    return _LOG_MAP if name.startswith("log.map.") else _REPLACED.get(name)


def check_choices(command: str, overrides: Sequence[str]) -> None:
    """Raises `InvalidArgumentError` for a choice of a group that the command cannot run.

    Hydra ignores a wrong choice of an optional group, and knows only one list of experiments.
    """
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
    except HydraException:
        return  # Hydra reports it
    if wrong := _wrong_choice(parsed, groups_of(command)):
        raise InvalidArgumentError(wrong)


def _wrong_choice(parsed: Sequence[Override], groups: dict[str, list[str]]) -> str | None:
    """What is wrong with the first choice that its group does not have."""
    for one in parsed:
        known = groups.get(_key(one), [])
        for text in _choices(one):
            key, _, choice = text.partition("=")
            if known and choice not in ("null", *known):
                return f"{text} does not exist{_hint(choice, known, f'{key}=')} {', '.join(known)}."
    return None


def _of_other_choices(groups: Collection[str]) -> Iterator[str]:
    """The options of all choices of the groups."""
    stored = ConfigStore.instance().repo.get("schema", {})
    for group in groups:
        for schema in stored.get(group, {}).values():
            yield from (f"{group}.{name}" for name in schema.node if name != "name")


def _key(override: Override) -> str:
    """The option or group that an override sets."""
    return str(override.get_key_element()).lstrip("+~")


def _choices(override: Override) -> list[str]:
    """The overrides that one override stands for: several in a sweep."""
    key = _key(override)
    if override.is_sweep_override() and override.is_discrete_sweep():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [f"{key}={override.get_value_element_as_str()}"]


def _names(config: DictConfig, prefix: str = "") -> Iterator[str]:
    """All dotted names in a configuration, those of groups of options included."""
    for key in map(str, config):
        yield f"{prefix}{key}"
        value = None if OmegaConf.is_missing(config, key) else config._get_node(key)
        if isinstance(value, DictConfig) and not value._is_none() and not value._is_interpolation():
            yield from _names(value, f"{prefix}{key}.")


def _is_free(config: DictConfig, name: str) -> bool:
    """Whether a name belongs to a group with free names, such as `method_options`."""
    parts = name.split(".")
    for depth in range(1, len(parts)):
        node = OmegaConf.select(config, ".".join(parts[:depth]), throw_on_missing=False)
        if isinstance(node, DictConfig) and _is_dict(node):
            return True
    return False


def _hint(wrong: str, known: Collection[str], prefix: str = "") -> str:
    """The end of a sentence that proposes the nearest known name."""

    def likeness(name: str) -> float:
        whole = SequenceMatcher(None, wrong, name).ratio()
        last = SequenceMatcher(None, wrong.rpartition(".")[2], name.rpartition(".")[2]).ratio()
        return max(whole, 0.95 * last)

    nearest = max(sorted(known), key=likeness, default=None)
    if nearest is None or likeness(nearest) < _NEAR:
        return "." if not prefix else "; choose from"
    return f"; did you mean {prefix}{nearest}?" + (" The choices are" if prefix else "")


def _first_lines(error: Exception) -> str:
    """The first lines of an error and of its cause: what was merged, and why that failed."""
    first = " ".join(str(error).split("\n\n")[0].split())
    cause = str(error.__cause__).splitlines()[0] if error.__cause__ is not None else ""
    merged = re.fullmatch(r"Error merging override (.*)", first)
    return f"{merged[1] if merged else first}: {cause}" if cause else first
