"""What gmmtorch-explore shows: a mission as it goes, and at its end, and several side by side."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from gmmtorch.cli import common

if TYPE_CHECKING:
    from torch import Tensor

    from gmmtorch.exploration.mission.mission import Mission
    from gmmtorch.exploration.mission.snapshots import Snapshot
    from gmmtorch.exploration.world.world import World
    from gmmtorch.mapping.components import Components
    from gmmtorch.report.exploration.mission_maps import TeamSnapshot
    from gmmtorch.report.maps.map_images import MapImage

_HALF_BAND = 0.6  # metres above and below the robots' first height that maps from above show


class MissionRecorder:
    """Notes what the pictures of one mission need while it runs, and draws them at its end.

    Numbers go to TensorBoard as they come; those of before a checkpoint, where a mission went on from one,
    at once. What the team knew is in `album`, and shown at the end.
    """

    def __init__(self, config: DictConfig, folder: Path, world: World) -> None:
        from gmmtorch.exploration.mission.snapshots import Snapshots
        from gmmtorch.report.tensorboard_writer import Board

        self._config, self._folder, self._world = config, folder, world
        self._board = Board(folder / "tensorboard") if config.report.tensorboard else None
        self._n_told = 0  # samples
        self._components: Components | None = None  # at the mission's end
        self.album = Snapshots(self._content)

    def sample(self, mission: Mission) -> None:
        """Take note of a mission that has just noted its own numbers."""
        if self._board is not None:
            curves = dict(mission.samples)
            times, robots = curves.pop("times"), curves.pop("entropy_bits_per_robot")
            curves |= {f"robot_{number}/entropy_bits": curve for number, curve in enumerate(robots)}
            for i in range(self._n_told, len(times)):
                numbers = {name: curve[i] for name, curve in curves.items()}
                self._board.scalars(numbers, "mission", step=int(times[i]))
            self._n_told = len(times)
            paths = {f"robot_{robot.number}/path_length": robot.path_length for robot in mission.robots}
            self._board.scalars(paths, "mission", step=int(mission.now))
        if mission.is_over:
            self._components = mission.robots[0].mapper.components()

    def finish(self, mission: Mission, row: dict[str, Any]) -> None:
        """Draw everything, save the mixture, and close TensorBoard.

        The mixture is that of the mission's end, as its row is: since then robots may have told one another
        more.
        """
        import torch

        from gmmtorch.exploration.mission.trials import TRAJECTORIES, save_trajectories
        from gmmtorch.report.exploration.mission_tensorboard import write_exploration_board

        paths = [torch.stack(path) for path in mission.trajectories]

        save_trajectories(mission, self._folder / TRAJECTORIES)
        components = self._components
        if components is not None and len(components):
            _save_mixture(components, self._world.resolution, self._folder / "map.safetensors")
        figures = self._figures(mission, row, paths, components)
        common.save_figures(self._config, figures, self._folder)
        if self._board is not None:
            for moment in self.album.chosen():
                seconds = moment.tick * mission.options.tick_seconds
                if "means" in moment.content:
                    mixture = (moment.content["means"], moment.content["covariances"])
                    self._board.ellipsoids("mixture", *mixture, step=int(seconds))
                self._board.paths("paths", [path[: moment.tick + 1] for path in paths], step=int(seconds))
            write_exploration_board(self._board, [row], figures)
            self._board.close()
        if self._config.report.recording:
            from gmmtorch.report.exploration.rerun_recording import RecordedMap, record_rerun

            record_rerun(
                self._folder / "mission.rrd",
                paths,
                period=mission.options.tick_seconds,
                maps=[
                    RecordedMap(
                        moment.tick * mission.options.tick_seconds,
                        moment.content["cells"],
                        moment.content.get("means", ()),
                        moment.content.get("covariances", ()),
                    )
                    for moment in self.album.moments
                    if "cells" in moment.content  # those of before a checkpoint may have been without
                ],
                resolution=self._world.resolution,
                row=row,
            )

    def _content(self, mission: Mission) -> dict[str, Any]:
        """What the team knows, for pictures: from above, as components, and for the recording as cells.

        Single precision is enough to draw from, and halves the checkpoints.
        """
        content = {"image": _team_view(mission).image.float()}
        surfaces = _surfaces(mission.robots[0].mapper.components())
        if surfaces is not None:
            content["means"] = surfaces.means.float()
            content["covariances"] = surfaces.covariances.float()
            content["owners"] = surfaces.ids[:, 0]
        if self._config.report.recording:
            stored = mission.union.grid.cells()
            occupied = (
                mission.union.rule.probability(stored.hits, stored.misses) > mission.union.rule.occupied
            )
            content["cells"] = stored.cells[occupied].int()
        return content

    def _snapshot(self, mission: Mission, moment: Snapshot, paths: list[Tensor]) -> TeamSnapshot:
        """A moment as the picture of the team's map shows it: components within the band of heights."""
        from gmmtorch.report.exploration.mission_maps import TeamSnapshot

        shown: dict[str, Any] = {}
        if "means" in moment.content:
            low, high = _band(mission)
            heights = moment.content["means"][:, 2]
            within = (heights > low) & (heights < high)
            shown = {name: moment.content[name][within] for name in ("means", "covariances", "owners")}
        return TeamSnapshot(
            moment.tick * mission.options.tick_seconds,
            _team_view(mission)._replace(image=moment.content["image"]),
            [path[: moment.tick + 1] for path in paths],
            caption=f"{100 * moment.bits / mission.union.observable_bits:.0f} % of the entropy gone",
            **shown,
        )

    def _figures(
        self, mission: Mission, row: dict[str, Any], paths: list[Tensor], components: Components | None
    ) -> dict[str, Any]:
        from gmmtorch.report.exploration.mission_bars import profile_figure, stage_means
        from gmmtorch.report.exploration.mission_curves import bandwidth_figure, entropy_figure
        from gmmtorch.report.exploration.mission_maps import team_map_figure, trajectories_figure
        from gmmtorch.report.scenes.cutaway import first_viewpoints
        from gmmtorch.report.scenes.scene import mixture_scene_figure

        if not (self._config.report.figures or self._config.report.tensorboard):
            return {}
        figures = {
            "entropy": entropy_figure([row]),
            "trajectories": trajectories_figure(_world_view(mission), paths, _coverage(mission)),
            "team_map": team_map_figure(
                [self._snapshot(mission, moment, paths) for moment in self.album.chosen()],
                belief=mission.union.rule,
            ),
            "profile": profile_figure(*stage_means([row])),
        }
        if row["bytes_sent"]:
            figures["bandwidth"] = bandwidth_figure([row], draco_error=mission.options.frame.noise)
        surfaces = _surfaces(components)
        if surfaces is not None:
            figures["mixture"] = mixture_scene_figure(
                surfaces.means,
                surfaces.covariances,
                seen_from=first_viewpoints(surfaces),
                trajectories=paths,
            )
        return figures


def save_comparison(config: DictConfig, rows: list[dict[str, Any]], folder: Path) -> None:
    """A study's summary, and its pictures: curves with bands over seeds, and bars.

    Where teams are flown on several networks, these are one picture, and all others are of the first.
    """
    from gmmtorch.exploration.mission.variants import NETWORK, differing
    from gmmtorch.files import write_bytes
    from gmmtorch.report.exploration.loss_figures import loss_figure
    from gmmtorch.report.exploration.mission_bars import profile_figure, stage_means, summary_bars
    from gmmtorch.report.exploration.mission_curves import (
        bandwidth_figure,
        entropy_figure,
        planner_comparison_figure,
    )
    from gmmtorch.report.exploration.mission_summary import study_summary
    from gmmtorch.report.exploration.mission_tensorboard import write_exploration_board
    from gmmtorch.report.tensorboard_writer import Board

    write_bytes(folder / "summary.md", study_summary(rows).encode())
    on_first, on_several = _by_networks(rows)
    figures: dict[str, Any] = {"profile": profile_figure(*stage_means(on_first))}
    if on_several:
        figures["loss"] = loss_figure(on_several)
    if len({row["framework"] for row in rows}) > 1:
        figures |= {
            "entropy": entropy_figure(on_first),
            "bandwidth": bandwidth_figure(on_first),
            "summary": summary_bars(on_first),
        }
    elif not on_several or differing(on_first, without=NETWORK):
        figures["planners"] = planner_comparison_figure(on_first)
    common.save_figures(config, figures, folder)
    if config.report.tensorboard:
        with Board(folder / "tensorboard") as board:
            write_exploration_board(board, rows, figures)


def _by_networks(rows: list[dict[str, Any]]) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Of each framework the rows on the first network that it was flown on; and, of those that were flown
    on several, all rows."""
    from gmmtorch.exploration.mission.variants import NETWORK, variant_of

    networks: dict[str, dict[Any, None]] = {}  # in the order they come
    for row in rows:
        networks.setdefault(row["framework"], {})[variant_of(row, NETWORK)] = None
    on_first = [row for row in rows if variant_of(row, NETWORK) == next(iter(networks[row["framework"]]))]
    return on_first, [row for row in rows if len(networks[row["framework"]]) > 1]


def _surfaces(components: Components | None) -> Components | None:
    """The components that stand for surfaces; None if there are none."""
    if components is None or not bool((~components.max_range).any()):
        return None
    return components.selected((~components.max_range).nonzero().squeeze(1))


def _save_mixture(components: Components, resolution: float, path: Path) -> None:
    """The mixture as a map that the other commands read."""
    from gmmtorch.mapping.gaussian_map import GaussianMap

    GaussianMap.of(components, resolution=resolution, codec="quantized").save(path)


def _band(mission: Mission) -> tuple[float, float]:
    """Heights (m) that maps from above show: around that at which the robots began."""
    height = float(mission.trajectories[0][0][2])
    return height - _HALF_BAND, height + _HALF_BAND


def _layers(mission: Mission) -> tuple[int, int]:
    """The same as layers of the world's box, from the first up to but without the last."""
    world = mission.world
    first, last = (round(z / world.resolution - float(world.box.low[2])) for z in _band(mission))
    return max(0, first), min(world.box.shape[2], max(first + 1, last))


def _view(mission: Mission, probability: Any) -> MapImage:
    from gmmtorch.report.maps.map_images import highest_occupancy

    low = mission.world.box.low.clone()
    low[2] += _layers(mission)[0]
    return highest_occupancy(probability, low.double() * mission.world.resolution, mission.world.resolution)


def _team_view(mission: Mission) -> MapImage:
    """The team's map from above, in the band of heights that the robots began in."""
    from gmmtorch.occupancy.voxels.boxes import Box

    box, (first, last) = mission.world.box, _layers(mission)
    low, high = box.low.clone(), box.high.clone()
    low[2], high[2] = box.low[2] + first, box.low[2] + last
    hits, misses = mission.union.grid.dense(Box(low, high))
    return _view(mission, mission.union.rule.probability(hits, misses))


def _world_view(mission: Mission) -> MapImage:
    """The true world from above, in the same band: occupied, free, or unseen by anybody ever."""
    first, last = _layers(mission)
    world = mission.world
    truth = world.occupied[:, :, first:last].float()
    return _view(mission, truth.masked_fill(~world.observable[:, :, first:last], 0.5))


def _coverage(mission: Mission) -> Any:
    """How many robots saw each column (nx, ny) in the band."""
    import torch

    first, last = _layers(mission)
    seen = mission.seen_by.view(mission.world.box.shape)[:, :, first:last]
    bits = torch.zeros(seen.shape[:2], dtype=torch.int64)
    for robot in mission.robots:
        bits += ((seen >> robot.number) & 1).any(2)
    return bits
