"""What EM makes of different starts, against the number of components (thesis Fig 2.1)."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report.curve_panels import Panel, line_label, panels_figure, subject
from gmmtorch.report.style import Rows

_COST = (
    Panel("init_seconds", "initialization time", "seconds", log=True),
    Panel("n_iterations", "iterations of EM", log=True),
    Panel("seconds", "initialization and EM", "seconds", log=True),
    Panel("psnr2_db", "PSNR2", "dB"),
)
_QUALITY = (
    Panel("psnr_forward_db", "points to the nearest drawn one (what is missed)", "dB", relative=True),
    Panel("psnr_backward_db", "drawn ones to the nearest point (what is invented)", "dB", relative=True),
    Panel("held_out_psnr2_db", "PSNR2 of points held out", "dB", relative=True),
    Panel("held_out_log_likelihood", "log-likelihood of points held out", "nats a point", relative=True),
)


def figures(rows: Rows) -> dict[str, Figure]:
    """`initialization`: initialization time, iterations, total time and PSNR2, as in Fig 2.1;
    `initialization_quality`: what is gained on the first start in both terms of PSNR2, and in PSNR2
    and likelihood of points held out.

    Args:
        rows: of the initialization study: `init_params`, `n_components`, and what is drawn.
    """
    first = line_label(str(rows[0]["init_params"]))
    about = subject(rows)
    return {
        "initialization": panels_figure(rows, _COST, "init_params", f"What EM makes of its start: {about}"),
        "initialization_quality": panels_figure(
            rows, _QUALITY, "init_params", f"What is gained over {first}: {about}"
        ),
    }
