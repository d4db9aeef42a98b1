"""Evidence of hits and misses, and the occupancy that follows from it (thesis chapter 3).

Public names are imported when they are first used, so that `import gmmtorch.occupancy` stays light.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.occupancy.cone_index import ConeIndex as ConeIndex
    from gmmtorch.occupancy.cones import Cones as Cones
    from gmmtorch.occupancy.evidence import CellClass as CellClass
    from gmmtorch.occupancy.evidence import Evidence as Evidence
    from gmmtorch.occupancy.evidence import Thresholds as Thresholds
    from gmmtorch.occupancy.evidence import occupancy_probability as occupancy_probability
    from gmmtorch.occupancy.forms.cone.cone_evidence import cone_evidence as cone_evidence
    from gmmtorch.occupancy.forms.flux.box_flux import box_flux as box_flux
    from gmmtorch.occupancy.forms.flux.box_flux import flux_evidence as flux_evidence
    from gmmtorch.occupancy.forms.flux.regions import Boundary as Boundary
    from gmmtorch.occupancy.forms.flux.regions import region_flux as region_flux
    from gmmtorch.occupancy.forms.monte_carlo import RayBundle as RayBundle
    from gmmtorch.occupancy.forms.monte_carlo import sample_rays as sample_rays
    from gmmtorch.occupancy.forms.point import PointEvidence as PointEvidence
    from gmmtorch.occupancy.forms.point import PointForm as PointForm
    from gmmtorch.occupancy.forms.point import point_evidence as point_evidence
    from gmmtorch.occupancy.grid import VoxelGrid as VoxelGrid
    from gmmtorch.occupancy.grid import rasterize as rasterize
    from gmmtorch.occupancy.protocol import OccupancyMap as OccupancyMap
    from gmmtorch.occupancy.ray_queries import ExpectedRange as ExpectedRange
    from gmmtorch.occupancy.ray_queries import RayHits as RayHits
    from gmmtorch.occupancy.ray_queries import expected_range as expected_range
    from gmmtorch.occupancy.ray_queries import hit_probability as hit_probability
    from gmmtorch.occupancy.voxels.boxes import Box as Box
    from gmmtorch.occupancy.voxels.cell_evidence import CellEvidence as CellEvidence
    from gmmtorch.occupancy.voxels.cell_evidence import sum_evidence as sum_evidence
    from gmmtorch.occupancy.voxels.ray_casting import cast_evidence as cast_evidence
    from gmmtorch.occupancy.voxels.rolling_window import RollingWindow as RollingWindow
    from gmmtorch.occupancy.voxels.sparse_evidence import SparseEvidence as SparseEvidence

_MODULES = {
    "cones": ["Cones"],
    "evidence": ["CellClass", "Evidence", "Thresholds", "occupancy_probability"],
    "forms.cone.cone_evidence": ["cone_evidence"],
    "forms.flux.box_flux": ["box_flux", "flux_evidence"],
    "forms.flux.regions": ["Boundary", "region_flux"],
    "forms.monte_carlo": ["RayBundle", "sample_rays"],
    "forms.point": ["PointEvidence", "PointForm", "point_evidence"],
    "grid": ["VoxelGrid", "rasterize"],
    "cone_index": ["ConeIndex"],
    "protocol": ["OccupancyMap"],
    "ray_queries": ["ExpectedRange", "RayHits", "expected_range", "hit_probability"],
    "voxels.boxes": ["Box"],
    "voxels.cell_evidence": ["CellEvidence", "sum_evidence"],
    "voxels.ray_casting": ["cast_evidence"],
    "voxels.rolling_window": ["RollingWindow"],
    "voxels.sparse_evidence": ["SparseEvidence"],
}
__getattr__, __dir__, __all__ = lazy_names(
    __name__, {name: module for module, names in _MODULES.items() for name in names}
)
