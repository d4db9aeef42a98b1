"""The types and defaults of all options, with a line on each for `--help`.

Options of a library class come from that class, by `schema_of`; so do the lines, from its docstring. Ranges
are checked by the library.
"""

from __future__ import annotations

import functools

from hydra.core.config_store import ConfigStore

from gmmtorch.cli.options import (
    dataset_schema,
    exploration_schema,
    map_schema,
    robot_schema,
)
from gmmtorch.cli.options.structured import read_dataclass, schema_of
from gmmtorch.evaluation.protocol_options import FitOptions, Protocol
from gmmtorch.evaluation.studies.study_options import (
    ApproximationErrorStudy,
    AucMemoryStudy,
    ComponentCountStudy,
    InitializationStudy,
    MapVariantsStudy,
    PoseCorrectionStudy,
    SensorModelStudy,
    VarianceThresholdStudy,
)
from gmmtorch.mapping.learning.rules import IncrementalRule, MixtureRule, WindowedRule
from gmmtorch.mapping.query_options import QueryOptions
from gmmtorch.mixture.reduction.prune_options import PruneOptions

STUDIES: dict[str, type] = {
    "approximation_error": ApproximationErrorStudy,
    "auc_memory": AucMemoryStudy,
    "component_count": ComponentCountStudy,
    "initialization": InitializationStudy,
    "map_variants": MapVariantsStudy,
    "pose_correction": PoseCorrectionStudy,
    "sensor_model": SensorModelStudy,
    "variance_threshold": VarianceThresholdStudy,
}
"""The options of each study by the study's name."""


def _map_schema(rule: type) -> type:
    """Options of a map: of its learning rule, and of its queries."""
    not_options = ("dtype", "random_state", "memory_limit", "compiled", "calibration")
    shared = (map_schema.MapFile, PruneOptions, MixtureRule)
    return schema_of(*shared, rule, QueryOptions, without=not_options)


def _sensor_schema() -> type:
    """Options of a live sensor."""
    return schema_of(robot_schema.SensorOptions, read_dataclass("live.mapper.live_scans", "LiveOptions"))


def _commands() -> dict[str, type]:
    """The options of each command."""
    mixture = schema_of(FitOptions, PruneOptions, without=("dtype", "compiled"))
    return {
        "fit": schema_of(map_schema.Fit, mixture=mixture),
        "map": map_schema.Map,
        "localize": map_schema.Localize,
        "occupancy": schema_of(map_schema.Occupancy, evaluation=schema_of(Protocol)),
        "export": map_schema.Export,
        "view": map_schema.View,
        "ros": schema_of(robot_schema.Ros, sensor=_sensor_schema()),
        "explore": exploration_schema.Explore,
        "robot": robot_schema.Robot,
    }


def _groups() -> dict[str, dict[str, type]]:
    """The options of each kind of a group."""
    studies = {name: schema_of(study, name=name) for name, study in STUDIES.items()}
    return {
        "map": {"windowed": _map_schema(WindowedRule), "incremental": _map_schema(IncrementalRule)},
        "study": {**studies, "trials": exploration_schema.TrialsStudy},
        "world": {
            "generated": exploration_schema.GeneratedWorld,
            "mesh": exploration_schema.MeshWorldOptions,
        },
        "team": {"team": exploration_schema.Team},
        "planner": {
            "planner": exploration_schema.PlannerOptions,
            "tree": exploration_schema.TreePlannerOptions,
        },
        "dataset": {
            "file": dataset_schema.FileDataset,
            "depth_frames": dataset_schema.DepthFramesDataset,
            "rosbag": dataset_schema.RosbagDataset,
            "kitti": dataset_schema.KittiDataset,
            "tum": dataset_schema.TumDataset,
            "mesh": dataset_schema.MeshDataset,
            "mesh_scans": dataset_schema.MeshScansDataset,
            "synthetic": dataset_schema.SyntheticDataset,
            "synthetic_building": dataset_schema.SyntheticBuildingDataset,
        },
    }


@functools.cache  # the tests call it often
def register() -> None:
    """Store the schemas in Hydra's config store, under the names that the files in conf/ use."""
    store = ConfigStore.instance()
    for command, options in _commands().items():
        store.store(name=f"{command}_schema", node=options)
    for group, kinds in _groups().items():
        for kind, options in kinds.items():
            store.store(group=f"schema/{group}", name=kind, node=options)
