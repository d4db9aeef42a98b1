"""Figures of EM after different initializations, against the number of components (thesis Fig 2.1)."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report.curve_panels import Panel, line_label, panels_figure, subject
from gmmtorch.report.style import Rows

_COST = (
    Panel("init_seconds", "initialization time", "seconds", log=True),
    Panel("n_iterations", "iterations of EM", log=True),
    Panel("seconds", "time of initialization and EM", "seconds", log=True),
    Panel("psnr2_db", "PSNR2", "dB"),
)
_QUALITY = (
    Panel("psnr_forward_db", "PSNR of points to the nearest sample", "dB", relative=True),
    Panel("psnr_backward_db", "PSNR of samples to the nearest point", "dB", relative=True),
    Panel("held_out_psnr2_db", "PSNR2 of held-out points", "dB", relative=True),
    Panel("held_out_log_likelihood", "log-likelihood of held-out points", "nats per point", relative=True),
)


def figures(rows: Rows) -> dict[str, Figure]:
    """Draws `initialization`: initialization time, iterations, total time and PSNR2, as in Fig 2.1; and
    `initialization_quality`: the gain over the first initialization in both terms of PSNR2, and in PSNR2 and
    log-likelihood of held-out points.

    Args:
        rows: of the initialization study: `init_params`, `n_components`, and the quantities drawn.
    """
    first, about = line_label(str(rows[0]["init_params"])), subject(rows)
    costs = panels_figure(rows, _COST, "init_params", f"EM after different initializations: {about}")
    gains = panels_figure(rows, _QUALITY, "init_params", f"Gain over {first}: {about}")
    return {"initialization": costs, "initialization_quality": gains}
