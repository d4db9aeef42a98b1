"""Missions from options: the world, the team, and the variants of a study."""

from __future__ import annotations

import zlib
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gmmtorch.cli import argument_names, as_options, build, naming
from gmmtorch.errors import InvalidArgumentError, check_choice
from gmmtorch.report import Event, ignore
from gmmtorch.team.exploration import PLANNING, THESIS, FrameRule, TeamOptions, Trial, World, WorldOptions

_OF_VARIANTS = {
    "team": "team.name",
    "planner": "planner.name",
    "information": "information",
    "coordination": "coordination",
}
"""The options that a variant of a study may set, beside those of `network.*`, by its names for them."""
_OF_PYTHON = {"planning_prior", "codec"}
"""Fields of `TeamOptions` that a variant may set, and that are no options."""


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
        prior = variant.get("planning_prior", 0.0)
        if not isinstance(prior, int | float):
            raise InvalidArgumentError(f"study.variants has planning_prior={prior!r}, which is not a number.")
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
    if config.world.name == "mesh" and not config.world.path:
        raise InvalidArgumentError(
            "world=mesh needs world.path=FILE: a triangle mesh (PLY, OBJ, STL) in metres, z up."
        )
    return build(WorldOptions, config)


def open_world(world: WorldOptions, team: TeamOptions, on_event: Event = ignore) -> World:
    """The world for this team; errors name options."""
    with naming(argument_names(WorldOptions)):
        return world.open(team, on_event)


def team_options(config: DictConfig, seed: int, variant: dict[str, Any]) -> TeamOptions:
    """The team that the options describe, with the changes of a variant: options, and fields of `TeamOptions`
    and of its rules."""
    options = {key: value for key, value in variant.items() if key in {*_OF_VARIANTS, *config.network}}
    names = {_name(key): f"study.variants: {key}" for key in options}
    rules: dict[str, dict[str, Any]] = {"novelty": {"resolution": config.world.resolution}, "frame": {}}
    for key in variant.keys() - options.keys() - _OF_PYTHON:
        rules["frame" if hasattr(FrameRule, key) else "novelty"][key] = variant[key]
    others = {key: variant[key] for key in _OF_PYTHON if key in variant}
    with naming(names):
        device = config.runtime.device
        made = build(TeamOptions, _changed(config, options), seed=seed, device=device, **others)
    changed = {name: replace(getattr(made, name), **values) for name, values in rules.items()}
    return replace(made, **changed)


def _name(key: str) -> str:
    """The option that a variant sets by a key."""
    return _OF_VARIANTS.get(key, f"network.{key}")


def _changed(config: DictConfig, options: dict[str, Any]) -> DictConfig:
    """The configuration with the options of a variant."""
    changed: DictConfig = OmegaConf.merge(config)  # type: ignore[assignment]
    for key, value in options.items():
        try:
            OmegaConf.update(changed, _name(key), value)
        except OmegaConfBaseException as error:
            raise InvalidArgumentError(
                f"study.variants has {key}={value!r}: {str(error).splitlines()[0]}."
            ) from error
    return changed
