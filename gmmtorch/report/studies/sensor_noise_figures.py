"""Whether it pays to tell the learning how the sensor errs: likelihood and occupancy against bytes."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report.curve_panels import Panel, panels_figure, subject
from gmmtorch.report.style import Rows

_PANELS = (
    Panel("held_out_log_likelihood", "log-likelihood of measurements held out", "nats a point"),
    Panel("thickness", "thickness of the components", "metres", log=True),
    Panel("auc", "AUC, free points anywhere on the beam", "area under the ROC curve"),
    Panel("auc_near_surface", "AUC, free points near the surface", "area under the ROC curve"),
)


def figures(rows: Rows) -> dict[str, Figure]:
    """`sensor_model`: likelihood, thickness and AUC of each variant against the bytes of its map.

    Args:
        rows: of `gmmtorch.evaluation.studies.sensor_noise`.
    """
    title = f"With and without the sensor's noise: {subject(rows)}"
    return {"sensor_model": panels_figure(rows, _PANELS, "variant", title, x="nbytes")}
