"""The types and defaults of the options of gmmtorch-explore, -robot, -team and -ros, for Hydra."""

from __future__ import annotations

import functools

from gmmtorch.cli import read_dataclass, schema_of, store
from gmmtorch.cli import register as register_maps
from gmmtorch.team.cli.options import exploration_schema, robot_schema


def _sensor_schema() -> type:
    """Options of a live sensor."""
    return schema_of(robot_schema.SensorOptions, read_dataclass("live.live_scans", "LiveOptions"))


@functools.cache
def register() -> None:
    """Stores the options of teams, and those of maps and data sets."""
    register_maps()
    commands = {
        "ros": schema_of(robot_schema.Ros, sensor=_sensor_schema()),
        "explore": exploration_schema.Explore,
        "robot": robot_schema.Robot,
    }
    groups: dict[str, dict[str, type]] = {
        "study": {"trials": exploration_schema.TrialsStudy},
        "world": {
            "generated": exploration_schema.GeneratedWorld,
            "mesh": exploration_schema.MeshWorldOptions,
        },
        "team": {"team": exploration_schema.Team},
        "planner": {
            "planner": exploration_schema.PlannerOptions,
            "tree": exploration_schema.TreePlannerOptions,
        },
    }
    store(commands, groups)
