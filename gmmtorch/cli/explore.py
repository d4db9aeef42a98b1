"""gmmtorch-explore: a team of robots explores a simulated world and maps it."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import TYPE_CHECKING, Any

import hydra
from omegaconf import DictConfig, OmegaConf

from gmmtorch.cli import common, schema

if TYPE_CHECKING:
    from gmmtorch.exploration.mission import Mission
    from gmmtorch.exploration.options import TeamOptions
    from gmmtorch.exploration.trials import Trial, WorldOptions
    from gmmtorch.report.progress import ProgressBars

_TABLE = (
    "framework seed planner t50 t90 entropy_reduction_bits bytes_sent bytes_raw_points auc "
    "cross_entropy_bits map_disagreement coverage_per_metre path_length collisions wall_seconds"
)

_NETWORK_TABLE = "wire_bytes bits_per_byte wire_ratio t90_ratio healed_after converged_after"

_STAGE = "simulated seconds"
_OF_ROBOTS = ("announce", "budget")  # options of the network that are not of its links


def main() -> None:
    """Entry point of the command."""
    schema.register()
    hydra.main(version_base="1.3", config_path=common.conf_dir(), config_name="explore")(_guarded)()


def _guarded(config: DictConfig) -> float | None:
    return common.run_guarded(run, config)


def run(config: DictConfig) -> float | None:
    """One run; returns the entropy reduction (bits) of the last mission, to be optimised over."""
    from gmmtorch.errors import InvalidArgumentError
    from gmmtorch.report.progress import ProgressBars

    if common.set_up(config) != "cpu":
        raise InvalidArgumentError(
            f"runtime.device={config.runtime.device} is not for exploring, which runs on the cpu."
        )
    if config.transport != "in_process":
        raise InvalidArgumentError(
            f"transport={config.transport!r} is not one of in_process; gmmtorch-team has the others."
        )
    folder = common.run_dir()
    with ProgressBars(enabled=config.report.progress) as bars:
        work = _explore if config.study is None else _compare
        rows = work(config, folder, bars)
    _print_rows(rows)
    common.print_files(folder, folder / "results.json")
    return float(rows[-1]["entropy_reduction_bits"])


def _explore(config: DictConfig, folder: Path, bars: ProgressBars) -> list[dict[str, Any]]:
    """One mission, shown as it goes."""
    from gmmtorch.cli.explore_pictures import MissionRecorder
    from gmmtorch.exploration.trials import run_mission

    trial = _trial(config, folder)
    world = trial.world.open(trial.team, bars)
    recorder = MissionRecorder(config, folder, world)

    def on_sample(mission: Mission) -> None:
        bars.note(_STAGE, _status(mission))
        bars(_STAGE, round(mission.now), round(trial.team.duration))
        recorder.sample(mission)

    mission, row = run_mission(trial, world, on_sample)
    rows = _compared([row])
    common.write_results("explore", config, rows, folder)
    recorder.finish(mission, rows[0])
    return rows


def _status(mission: Mission) -> str:
    """Entropy left, bytes sent and the pace, for the progress bar."""
    left = mission.union.entropy_bits / max(1.0, mission.union.observable_bits)
    seconds = sum(mission.stages.values())
    pace = f", {mission.now / seconds:.1f}x real time" if seconds > 0 else ""
    return f"{left:.1%} of the entropy left, {mission.network.n_bytes / 1e3:,.0f} kB sent{pace}"


def _compare(config: DictConfig, folder: Path, bars: ProgressBars) -> list[dict[str, Any]]:
    """Every variant of a study with every seed."""
    from gmmtorch.cli.explore_pictures import save_comparison
    from gmmtorch.exploration.trials import run_trials

    variants = _variants(config)
    trials = [_trial(config, folder, variant, seed) for seed in config.study.seeds for variant in variants]
    trials[0].world.open(trials[0].team, bars)  # into the cache, before several ask for it at once
    done: list[dict[str, Any]] = []

    def keep(row: dict[str, Any]) -> None:
        done.append(row)
        common.write_results("explore", config, _compared(done), folder)

    rows = _compared(run_trials(trials, config.runtime.workers, keep, bars))
    common.write_results("explore", config, rows, folder)
    save_comparison(config, rows, folder)
    return rows


def _print_rows(rows: list[dict[str, Any]]) -> None:
    """The table; of several variants each has a name, and what networks cost is told where they differ."""
    from gmmtorch.exploration.variants import NETWORK, differing

    columns = _TABLE.split()
    title = f"{rows[0]['world']}: {rows[0]['n_robots']} robots"
    if fields := differing(rows):
        from gmmtorch.report.exploration_variants import by_variant

        rows = [{"variant": name, **row} for name, group in by_variant(rows).items() for row in group]
        named = [name for name in columns if name not in ("framework", "planner")]
        columns = ["variant", *named, *(_NETWORK_TABLE.split() if {*fields} & {*NETWORK} else ())]
    common.print_table(rows, columns, title)


def _compared(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows with what only those beside them tell."""
    from gmmtorch.exploration.network_outcome import with_network_costs
    from gmmtorch.exploration.outcome import with_times

    return with_network_costs(with_times(rows))


def _variants(config: DictConfig) -> list[dict[str, Any]]:
    from gmmtorch.errors import InvalidArgumentError

    if config.study.name != "trials":
        raise InvalidArgumentError(f"study.name={config.study.name!r} is not known; known is trials.")
    variants: list[dict[str, Any]] = list(common.as_options(config.study)["variants"])
    known = {"team", "planner", "information", "coordination", "planning_prior", "codec", *config.network}
    for variant in variants:
        if not set(variant) <= known:
            raise InvalidArgumentError(
                f"study.variants has {sorted(set(variant) - known)}; a variant may set "
                f"{', '.join(sorted(known))}."
            )
        for key in ("planning_prior", *_OF_ROBOTS):
            value = variant.get(key, 0.0)
            if not (isinstance(value, int | float) or (key == "budget" and value is None)):
                raise InvalidArgumentError(f"study.variants has {key}={value!r}, which is no number.")
    if not variants or not config.study.seeds:
        raise InvalidArgumentError("study.variants and study.seeds must each have at least one entry.")
    return variants


def _trial(
    config: DictConfig, folder: Path, variant: dict[str, Any] | None = None, seed: int | None = None
) -> Trial:
    """The mission that the options describe, but for what a variant sets."""
    from gmmtorch.exploration.trials import Trial

    home = Path(config.checkpoint.folder) if config.checkpoint.folder else folder
    seed = config.seed if seed is None else seed
    chosen = {"team": config.team.name, "planner": config.planner.name} if variant is None else variant
    about = "_".join(f"{key}-{_short(value)}" for key, value in chosen.items())
    home = home / "trials" / f"{about}_seed-{seed}"  # sweeps may share a folder
    return Trial(
        world=world_options(config),
        team=team_options(config, seed, variant or {}),
        folder=home,
        checkpoint_every=config.checkpoint.every,
    )


def _short(value: Any) -> str:
    """A value in the name of a folder: lists are too long for one."""
    return f"{zlib.crc32(repr(value).encode()):08x}" if isinstance(value, list) else str(value)


def world_options(config: DictConfig) -> WorldOptions:
    """The world that the options describe."""
    from gmmtorch.exploration.trials import WorldOptions

    options: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value
        for key, value in common.as_options(config.world).items()
    }
    return WorldOptions(**options, cache=config.runtime.cache)


def team_options(config: DictConfig, seed: int, variant: dict[str, Any]) -> TeamOptions:
    """The team that the options describe, but for what a variant sets."""
    from gmmtorch.exploration.mixture_mapper import FrameRule
    from gmmtorch.exploration.options import TeamOptions
    from gmmtorch.exploration.primitives import Dynamics
    from gmmtorch.exploration.returns import RestRule
    from gmmtorch.exploration.scoring import BeliefRule
    from gmmtorch.mapping.novelty import NoveltyRule
    from gmmtorch.simulation.depth_camera import DepthCamera

    sensor, mapping = common.as_options(config.sensor), common.as_options(config.map)
    rate, window = sensor.pop("rate"), mapping.pop("window")
    threshold, observed, distance = (mapping.pop(name) for name in ("threshold", "observed", "distance"))
    start: Any = config.team.start
    start = OmegaConf.to_container(start) if OmegaConf.is_config(start) else start
    return TeamOptions(
        framework=variant.get("team", config.team.name),
        size=config.team.size,
        duration=config.duration,
        seed=seed,
        rate=rate,
        camera=DepthCamera(**sensor),
        dynamics=Dynamics(**common.as_options(config.robot)),
        belief=BeliefRule(**common.as_options(config.belief)),
        novelty=NoveltyRule(
            resolution=config.world.resolution,
            threshold=threshold,
            observed=observed,
            prior=config.belief.prior,
            distance=distance,
        ),
        frame=FrameRule(**mapping),
        window=_three("map.window", window),
        planner=variant.get("planner", config.planner.name),
        information=variant.get("information", config.information),
        n_beams=config.planner.get("beams", 160),
        coordination=variant.get("coordination", config.coordination),
        n_rounds=config.rounds,
        planning_prior=variant.get("planning_prior", config.planner.prior),
        rest=RestRule(config.planner.rest),
        codec=variant.get("codec", config.codec),
        **_network(config, variant),
        announce_every=variant.get("announce", config.network.announce),
        budget=variant.get("budget", config.network.budget),
        sample_every=config.evaluation.every,
        codecs=tuple(config.evaluation.get("codecs", ())),
        start=None if start is None else _poses(start),
    )


def _network(config: DictConfig, variant: dict[str, Any]) -> dict[str, Any]:
    """What `TeamOptions` has of the network; errors call it what the user does."""
    from gmmtorch.sharing.link_conditions import LinkConditions

    given = {key: value for key, value in common.as_options(config.network).items() if key not in _OF_ROBOTS}
    names = {key: f"study.variants: {key}" if key in variant else f"network.{key}" for key in given}
    given |= {key: variant[key] for key in given if key in variant}
    if "delay" in given:  # which a real network has, whatever anybody says
        given["latency"], names["latency"] = given.pop("delay"), names.pop("delay")
    conditions = LinkConditions(**given, names=names)
    conditions.check_team(config.team.size, names)
    return {name: getattr(conditions, name) for name in given}


def _poses(start: Any) -> tuple[tuple[float, ...], ...]:
    """Start poses as they are given; raises `InvalidArgumentError` unless they are four numbers each."""
    from gmmtorch.errors import InvalidArgumentError

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
    from gmmtorch.errors import InvalidArgumentError

    if len(values) != 3:
        raise InvalidArgumentError(f"{name}={values} must have three entries: cells along x, y and z.")
    return values[0], values[1], values[2]


if __name__ == "__main__":
    main()
