"""Workers of a launch that wait for each other: each reads what its neighbour wrote before."""

from __future__ import annotations

from pathlib import Path

import torch

from gmmtorch.kernels import compiler
from gmmtorch.kernels.compiler import FusedKernel, Team

KERNEL = """#include "{device}"
namespace gmm {{
GMM_KERNEL passed_on(int64_t item, Team team, int64_t times, int64_t* values, int64_t* faults) {{
    for (int64_t round = 1; round <= times; ++round) {{
        values[item] = round;
        meet(team);
        if (((volatile int64_t*)values)[(item + 61 * round) % team.n] != round) faults[item] += 1;
        meet(team);
    }}
}}
}}
"""


def test_no_worker_of_a_team_reads_before_the_others_have_written(tmp_path, device):
    source = tmp_path / "passed_on.h"
    source.write_text(KERNEL.format(device=Path(compiler.__file__).parent / "device.h"))
    where = torch.device(device)
    team = Team.of(where)
    values, faults = torch.zeros(2, team.n, dtype=torch.int64, device=where)
    FusedKernel(str(source), "passed_on")(team.n, *team, 50, values, faults)
    assert values.eq(50).all()
    assert not faults.any()
