"""The types and defaults of the options of gmmtorch-map, -localize, -export and -view, for Hydra.

Options of a library class come from that class, by `schema_of`. Ranges are checked by the library.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping

from hydra.core.config_store import ConfigStore

from gmmtorch.cli.options import dataset_schema, map_schema
from gmmtorch.cli.options.structured import schema_of
from gmmtorch.mapping import IncrementalRule, MixtureRule, QueryOptions, WindowedRule
from gmmtorch.mixture import PruneOptions


def _map_schema(rule: type) -> type:
    """Options of a map: of its learning rule, and of its queries."""
    not_options = ("dtype", "random_state", "memory_limit", "compiled", "calibration")
    shared = (map_schema.MapFile, PruneOptions, MixtureRule)
    return schema_of(*shared, rule, QueryOptions, without=not_options)


def store(commands: Mapping[str, type], groups: Mapping[str, Mapping[str, type]]) -> None:
    """Stores schemas in Hydra's config store, under the names that the files in conf/ use.

    commands: the options of each command. groups: the options of each kind of a group.
    """
    hydra = ConfigStore.instance()
    for command, options in commands.items():
        hydra.store(name=f"{command}_schema", node=options)
    for group, kinds in groups.items():
        for kind, options in kinds.items():
            hydra.store(group=f"schema/{group}", name=kind, node=options)


@functools.cache  # the tests call it often
def register() -> None:
    """Stores the options of maps, data sets and their commands."""
    commands = {
        "map": map_schema.Map,
        "localize": map_schema.Localize,
        "export": map_schema.Export,
        "view": map_schema.View,
    }
    groups = {
        "map": {"windowed": _map_schema(WindowedRule), "incremental": _map_schema(IncrementalRule)},
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
    store(commands, groups)
