"""gmmtorch-ros plays a recording, maps the topic of a sensor, or localises the sensor in a map."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from omegaconf import DictConfig

from gmmtorch.cli import (
    TRAJECTORY,
    Checkpoint,
    as_options,
    build,
    map_factory,
    naming,
    open_live_view,
    open_map,
    print_files,
    print_skipped,
    print_table,
    run_dir,
    stop_requests,
    write_results,
    write_trajectory,
)
from gmmtorch.datasets import Ranges
from gmmtorch.errors import InvalidArgumentError
from gmmtorch.export import write_tum
from gmmtorch.live import (
    MAP,
    BagPlayer,
    BuildMoments,
    LiveLocalizer,
    LiveMapper,
    LiveOptions,
    LiveScans,
    MapPublisher,
    Node,
    find_sensor,
    open_scans,
    warm_up,
)
from gmmtorch.mapping import GaussianMap
from gmmtorch.report import ProgressBars, Row
from gmmtorch.team.exploration import WallClock, settle
from gmmtorch.team.sharing import SharedMap

_TABLE = "topic n_scans n_dropped n_malformed latency_median latency_p99 n_components nbytes"


def open_node(config: DictConfig) -> Node:
    """The node of the options `node.*` and `remap`."""
    options = as_options(config.node)
    if config.play:  # the player makes the time
        options["use_sim_time"] = False
    remap = {} if config.remap is None else config.remap
    if not isinstance(remap, Mapping):
        raise InvalidArgumentError(f"remap={remap} must be {{/topic: /other_topic}}.")
    remap = {str(topic): str(other) for topic, other in remap.items()}
    names = {name: f"node.{name}" for name in options}
    with naming(names):
        node = Node("gmmtorch_player" if config.play else "gmmtorch", **options, remap=remap)
    node.option_names = names | {name: f"sensor.{name}" for name in map(str, config.sensor)}
    return node


def play(config: DictConfig, node: Node) -> None:
    """Publish a recording, once somebody subscribes to it."""
    with naming({"rate": "speed"}):
        player = BagPlayer(node, config.play, config.speed)
    for topic in player.unknown:
        print(f"skipped   {topic.name}: {topic.type} is not a type of ROS 2 Jazzy")
    if not player.wait_for_subscriber(config.wait):
        print(f"no node subscribes to the recording after {config.wait:g} s; it is played anyway")
    with ProgressBars(enabled=config.report.progress) as bars, stop_requests() as is_stopped:
        for _ in player.play():
            bars("playing", player.n_played, player.n_messages)
            if is_stopped():
                break
    print(f"played    {player.n_played:,} of {player.n_messages:,} messages of {config.play}")


def build_map(config: DictConfig, node: Node, device: str, shared: SharedMap | None) -> None:
    """Build a map of the sensor's topic, and write it at the end."""
    make_map = map_factory(config, resolution=config.resolution)
    warm_up(make_map(), device)
    target = make_map()
    scans = _scans(config, node)
    mapper = LiveMapper(node, scans, target, _publisher(config, node), config.period, device, shared)
    folder = run_dir()
    view = open_live_view(config)
    moments = BuildMoments(mapper.builder, lambda: mapper.nbytes, shared)
    checkpoint = Checkpoint(config, mapper.builder, "sensor", time.monotonic)
    if checkpoint.is_continued:
        scans.continue_in(mapper.builder.map)
    n_saved_corrections = 0

    def team() -> str:
        if shared is None:
            return ""
        n_conflicts = shared.replica.duplicates[shared.replica.robot]
        if (conflict := shared.radio.duplicate_id(n_conflicts)) is not None:
            node.warn("id", conflict)
        return f", {shared.replica.n_components:,} of the team{shared.radio.warnings(n_conflicts)}"

    def after_scan() -> None:
        nonlocal n_saved_corrections
        now = mapper.builder.progress()
        bars("mapping", now.n_read, None)
        bars.note("mapping", f"{now.n_components:,} components, {scans.n_dropped:,} dropped{team()}")
        if mapper.n_corrections > n_saved_corrections:  # teammates know the poses of closed loops already
            checkpoint.save()
            n_saved_corrections = mapper.n_corrections
        else:
            checkpoint.save_when_due()
        if view is not None:
            moments.note()
            if mapper.builder.map.n_pending == 0:
                view.offer(moments)

    with ProgressBars(enabled=config.report.progress) as bars:
        _until_stopped(config, node, scans, mapper, after_scan)
        mapper.finish()
        if shared is not None:
            settle(shared, WallClock(), config.settle)
    _write(config, mapper, shared, scans, folder)
    checkpoint.remove()


def localize(config: DictConfig, node: Node, device: str) -> None:
    """Localise the sensor in a map that stays as it is; write the trajectory at the end."""
    if config.sensor.poses not in ("tf", "standing"):
        raise InvalidArgumentError(
            f"sensor.poses={config.sensor.poses} does not go with localize, which finds the poses itself. "
            "Use sensor.poses=tf, whose motion predicts them, or standing."
        )
    known = open_map(Path(config.localize).expanduser(), config.runtime)
    scans = _scans(config, node)
    localizer = LiveLocalizer(node, scans, known, config.sensor.poses == "tf", device)
    _publisher(config, node).publish(known, MAP, node.now())
    with ProgressBars(enabled=config.report.progress) as bars:

        def after_scan() -> None:
            bars("localising", localizer.n_scans, None)
            bars.note("localising", f"{localizer.n_lost:,} lost, {scans.n_dropped:,} dropped")

        _until_stopped(config, node, scans, localizer, after_scan)
    folder = run_dir()
    if localizer.poses:
        times = torch.tensor(localizer.times, dtype=torch.float64)
        write_tum(folder / TRAJECTORY, times, torch.stack(localizer.poses))
    numbers = localizer.diagnostics.numbers(localizer.n_scans, known.n_components)
    row = {"topic": scans.name, **numbers, "n_lost": localizer.n_lost, "nbytes": known.nbytes}
    _write_results(config, row, scans, folder, _TABLE.replace("n_dropped", "n_lost n_dropped"))


def _scans(config: DictConfig, node: Node) -> LiveScans:
    """The scans of the sensor's topic, which is found by itself if it is not given."""
    live = build(LiveOptions, config, "sensor")
    with naming({name: f"sensor.{name}" for name in ("max_range", "no_return_range")}):
        ranges = Ranges(config.sensor.max_range, config.sensor.no_return_range)
    sensor = find_sensor(node, config.sensor.topic, config.wait)
    print(f"topic     {sensor.topic.name} ({sensor.topic.type})", flush=True)
    return open_scans(node, sensor, ranges, live)


def _publisher(config: DictConfig, node: Node) -> MapPublisher:
    band = config.z_min, config.z_max
    return MapPublisher(node, config.resolution, *band, cloud=config.cloud, ellipsoids=config.ellipsoids)


def _until_stopped(
    config: DictConfig,
    node: Node,
    scans: LiveScans,
    worker: LiveMapper | LiveLocalizer,
    after_scan: Callable[[], None],
) -> None:
    """Handles scans until Ctrl-C; says why there are none."""
    begin = time.monotonic()
    with stop_requests() as is_stopped:
        while not is_stopped():
            if worker.step():
                after_scan()
            elif not len(scans) and time.monotonic() - begin > config.wait:
                node.warn("silence", f"no scan can be used: {_trouble(node, scans)}.")


def _trouble(node: Node, scans: LiveScans) -> str:
    """Why no scan was mapped so far."""
    silent = [s for s in node.subscriptions if s.n_received == 0 and not s.topic.endswith("/tf_static")]
    if silent:
        remedy = {"/tf": "; sensor.poses=mixture estimates the poses from the scans, without TF"}
        return "; ".join(node.explain_silence(topic) + remedy.get(topic.topic, "") for topic in silent)
    reasons = ", ".join(f"{reason} ({n} scans)" for reason, n in scans.skipped.items())
    return "; ".join(text for text in (reasons, scans.trouble) if text) or "the scans wait for their poses"


def _write(
    config: DictConfig, mapper: LiveMapper, shared: SharedMap | None, scans: LiveScans, folder: Path
) -> None:
    """Write the map, the trajectory and results.json, and print a table."""
    builder = mapper.builder
    n_scans = len(builder.record.indices)
    row = {"topic": scans.name, **mapper.diagnostics.numbers(n_scans, 0)}
    made: dict[str, GaussianMap] = {}
    if n_scans:
        made["map"] = builder.map
        write_trajectory(builder, folder)
        row |= {"n_components": builder.map.n_components, "nbytes": builder.map.nbytes}
    if shared is not None:
        row["team"] = shared.row()
        if n_scans:
            made["team_map"] = mapper.snapshot(builder.map.codec)
    for name, one in made.items():
        one.save(folder / f"{name}.safetensors")
    _write_results(config, row, scans, folder, _TABLE)
    for name in made:
        print(f"{name:<9} {folder / name}.safetensors")


def _write_results(config: DictConfig, row: Row, scans: LiveScans, folder: Path, columns: str) -> None:
    """Write results.json, and print its row and what was left out."""
    row["skipped"] = [{"reason": reason, "n_scans": n} for reason, n in scans.skipped.items()]
    row = {key: None if value != value else value for key, value in row.items()}  # JSON has no NaN
    write_results("ros", config, [row], folder)
    print_table([row], columns.split(), f"{scans.name}: {row['n_scans']} scans")
    print_skipped(scans.skipped)
    print_files(folder)
