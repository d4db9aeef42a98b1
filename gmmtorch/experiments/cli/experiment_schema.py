"""The studies of gmmtorch-fit and gmmtorch-occupancy, and their options for Hydra."""

from __future__ import annotations

import functools

from gmmtorch.cli import register as register_inputs
from gmmtorch.cli import schema_of, store
from gmmtorch.experiments.studies import (
    ApproximationErrorStudy,
    AucMemoryStudy,
    ComponentCountStudy,
    InitializationStudy,
    MapVariantsStudy,
    PoseCorrectionStudy,
    SensorModelStudy,
    VarianceThresholdStudy,
)

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


@functools.cache
def register() -> None:
    """Stores the options of studies, maps and data sets."""
    register_inputs()
    store({}, {"study": {name: schema_of(study, name=name) for name, study in STUDIES.items()}})
