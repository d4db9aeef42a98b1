"""A component with one origin, and dense evidence."""

from __future__ import annotations

from contextlib import ExitStack
from unittest.mock import patch

import torch
from torch import Tensor

from gmmtorch.kernels.rays import component_casting
from gmmtorch.mapping.components import Components
from gmmtorch.occupancy.voxels.cells import Box, CellEvidence
from gmmtorch.team.exploration.robot import component_rays
from gmmtorch.team.exploration.robot.component_rays import RayRule, component_evidence

EVERYTHING = Box(torch.tensor([-4096] * 3), torch.tensor([4096] * 3))


def evidence_of(
    components: Components, resolution: float, box: Box, thinned: bool = False, **options
) -> CellEvidence:
    """`thinned`: as robots count; otherwise all rays are followed all of their way."""
    with ExitStack() as stack:
        for module in (component_rays, component_casting) if not thinned else ():
            stack.enter_context(patch.object(module, "THINNING", 1))
        return component_evidence(components, box, RayRule(resolution, **options))


def one(covariance, mean=(4.0, 1.0, 0.5), origin=(0.1, 0.2, 0.3), count=100.0, sequence=0) -> Components:
    """A component with one origin."""
    return Components(
        means=torch.tensor([mean], dtype=torch.float64),
        covariances=torch.as_tensor(covariance, dtype=torch.float64)[None],
        support=torch.tensor([count], dtype=torch.float64),
        max_range=torch.tensor([False]),
        ids=torch.tensor([[2, sequence]]),
        origins=torch.tensor([origin], dtype=torch.float64),
        seen_by=torch.tensor([0]),
        seen_from=torch.tensor([0]),
        seen_count=torch.tensor([count], dtype=torch.float64),
    )


def dense(evidence: CellEvidence, box: Box) -> Tensor:
    both = torch.zeros(2, *box.shape, dtype=torch.float64)
    x, y, z = (evidence.cells - box.low).unbind(1)
    both[0, x, y, z], both[1, x, y, z] = evidence.hits.double(), evidence.misses.double()
    return both
