"""Missions from options: the world, the team, and the variants of a study."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import as_options, naming
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.events import Event, ignore
from gmmtorch.mapping import NoveltyRule
from gmmtorch.simulation import DepthCamera
from gmmtorch.team.exploration import (
    PLANNING,
    THESIS,
    BeliefRule,
    Dynamics,
    FrameRule,
    StoppingRule,
    TeamOptions,
    Trial,
    World,
    WorldOptions,
)
from gmmtorch.team.sharing import LinkConditions

T = TypeVar("T")
OF_ROBOTS = {"announce": "announce_every", "budget": "budget"}
"""Arguments of robots by the options of `network.*` that they come from; the others are of the links."""
NAMES = {
    "rate": "sensor.rate",
    "horizontal_fov": "sensor.horizontal_fov",
    "vertical_fov": "sensor.vertical_fov",
    "max_range": "sensor.max_range",
    "robot_radius": "robot.radius",
    "resolution": "world.resolution",
    "prior": "belief.prior",
    "n_beams": "planner.beams",
    "n_rounds": "rounds",
    **{argument: f"network.{option}" for option, argument in OF_ROBOTS.items()},
    "sample_every": "evaluation.every",
}
"""Options by the arguments that they become, for error messages."""


def variants_of(config: DictConfig) -> list[dict[str, Any]]:
    """The variants of a study. Raises `InvalidArgumentError` for options that a variant cannot set."""
    check_choice("study.name", config.study.name, ("trials",))
    variants: list[dict[str, Any]] = list(as_options(config.study)["variants"])
    known = {"team", *PLANNING, *THESIS, *config.network}
    for variant in variants:
        if not set(variant) <= known:
            raise InvalidArgumentError(
                f"study.variants has {sorted(set(variant) - known)}; a variant may set "
                f"{', '.join(sorted(known))}."
            )
        for key in ("planning_prior", *OF_ROBOTS):
            value = variant.get(key, 0.0)
            if not (isinstance(value, int | float) or (key == "budget" and value is None)):
                raise InvalidArgumentError(f"study.variants has {key}={value!r}, which is not a number.")
    if config.team.name == "gmm_thesis" and any("team" in variant for variant in variants):
        raise InvalidArgumentError(
            "team=gmm_thesis sets options of all teams of the study; use its variants: {team: gmm_thesis}."
        )
    if not variants or not config.study.seeds:
        raise InvalidArgumentError("study.variants and study.seeds must each have at least one entry.")
    return variants


def trial_of(
    config: DictConfig, folder: Path, variant: dict[str, Any] | None = None, seed: int | None = None
) -> Trial:
    """A trial of the mission that the options describe, with the changes of a variant, and a folder in
    `folder`."""
    seed = config.seed if seed is None else seed
    chosen = {"team": config.team.name, "planner": config.planner.name} if variant is None else variant
    about = "_".join(f"{key}-{_short(value)}" for key, value in chosen.items())
    trial = Trial(world=world_options(config), team=team_options(config, seed, variant or {}))
    return replace(trial, folder=folder / "trials" / f"{about}_seed-{seed}_{trial.digest}")


def _short(value: Any) -> str:
    """A value for the name of a folder; a checksum of a list, which would be too long."""
    return f"{zlib.crc32(repr(value).encode()):08x}" if isinstance(value, list) else str(value)


def world_options(config: DictConfig) -> WorldOptions:
    """The world that the options describe."""
    if OmegaConf.is_missing(config.world, "path"):
        raise InvalidArgumentError(
            "world=mesh needs world.path=FILE: a triangle mesh (PLY, OBJ, STL) in metres, z up."
        )
    options: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in as_options(config.world).items()
    }
    return WorldOptions(**options, cache=config.runtime.cache)


def open_world(world: WorldOptions, team: TeamOptions, on_event: Event | None = None) -> World:
    """The world for this team; errors name options."""
    names = {name: f"world.{name}" for name in ("path", "bounds", "size", "seed")}
    with naming({**NAMES, **names}):
        return world.open(team, on_event or ignore)


def team_options(config: DictConfig, seed: int, variant: dict[str, Any]) -> TeamOptions:
    """The team that the options describe, with the changes of a variant."""
    sensor, mapping = as_options(config.sensor), as_options(config.map)
    mapping |= {name: variant[name] for name in mapping if name in variant and name in THESIS}
    rate, window = sensor.pop("rate"), mapping.pop("window")
    novelty = {name: mapping.pop(name) for name in ("threshold", "observed", "distance", "distance_for")}
    learning = {**mapping, **novelty, "codec": config.codec}
    start: Any = config.team.start
    start = OmegaConf.to_container(start) if OmegaConf.is_config(start) else start
    names = {name: f"study.variants: {option}" for option, name in OF_ROBOTS.items() if option in variant}
    with naming({**NAMES, **names}):
        options = TeamOptions(
            framework=variant.get("team", config.team.name),
            size=config.team.size,
            duration=config.duration,
            seed=seed,
            rate=rate,
            camera=_of("sensor", DepthCamera, sensor),
            dynamics=_of("robot", Dynamics, as_options(config.robot)),
            belief=_of("belief", BeliefRule, as_options(config.belief)),
            novelty=_of(
                "map", NoveltyRule, novelty, resolution=config.world.resolution, prior=config.belief.prior
            ),
            frame=_of("map", FrameRule, mapping),
            window=_three("map.window", window),
            planner=variant.get("planner", config.planner.name),
            information=variant.get("information", config.information),
            n_beams=config.planner.get("beams", 160),
            coordination=variant.get("coordination", config.coordination),
            n_rounds=config.rounds,
            planning_prior=variant.get("planning_prior", config.planner.prior),
            rest=StoppingRule(config.planner.rest),
            codec=variant.get("codec", config.codec),
            **_network(config, variant),
            **{name: variant.get(option, config.network[option]) for option, name in OF_ROBOTS.items()},
            sample_every=config.evaluation.every,
            codecs=tuple(config.evaluation.get("codecs", ())),
            start=None if start is None else _poses(start),
            device=config.runtime.device,
        )
    if "team" not in variant and options.framework == "gmm_thesis":
        _check_thesis(learning, options)
    return options


def _check_thesis(given: dict[str, Any], options: TeamOptions) -> None:
    """Raises `InvalidArgumentError` if the options `given` of team=gmm_thesis are not those of the thesis."""
    for name, value in options.learning.items():
        if given[name] != value:
            raise InvalidArgumentError(
                f"team=gmm_thesis with {name}={given[name]}: E0 of the thesis has {value}. Use "
                "team=gmm_shared, which takes any value."
            )


def log_map_options(config: DictConfig) -> DictConfig:
    """The options that `maps.map_factory` reads: `log.map`, on the CPU."""
    runtime = {"memory_limit": config.runtime.memory_limit, "compile": False, "dtype": "float64"}
    return OmegaConf.create({"map": config.log.map, "runtime": runtime, "seed": config.seed})


def _of(group: str, make: Callable[..., T], options: dict[str, Any], **others: Any) -> T:
    """The value that `make` builds from the options of a group, and from others; errors name options."""
    with naming({name: f"{group}.{name}" for name in options}):
        return make(**options, **others)


def _network(config: DictConfig, variant: dict[str, Any]) -> dict[str, Any]:
    """The fields of `TeamOptions` for the network; errors name options."""
    given = {key: value for key, value in as_options(config.network).items() if key not in OF_ROBOTS}
    names = {key: f"study.variants: {key}" if key in variant else f"network.{key}" for key in given}
    given |= {key: variant[key] for key in given if key in variant}
    if "delay" in given:  # a real network has its own
        given["latency"], names["latency"] = given.pop("delay"), names.pop("delay")
    with naming(names):
        conditions = LinkConditions(**given)
        conditions.check_team(config.team.size)
    return {name: getattr(conditions, name) for name in given}


def _poses(start: Any) -> tuple[tuple[float, ...], ...]:
    """Start poses as tuples. Raises `InvalidArgumentError` unless each has four numbers."""
    try:
        poses = tuple(tuple(float(x) for x in pose) for pose in start)
    except (TypeError, ValueError):
        poses = ()
    if not poses or any(len(pose) != 4 for pose in poses):
        raise InvalidArgumentError(
            f"team.start={start} must be poses of four numbers each: [[x, y, z, yaw], …], m and rad."
        )
    return poses


def _three(name: str, values: list[int]) -> tuple[int, int, int]:
    if len(values) != 3:
        raise InvalidArgumentError(f"{name}={values} must have three entries: cells along x, y and z.")
    return values[0], values[1], values[2]
