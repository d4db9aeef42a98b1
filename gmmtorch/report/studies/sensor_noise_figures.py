"""Figure of fitting with and without a model of the sensor's noise."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report.curve_panels import Panel, panels_figure, subject
from gmmtorch.report.style import Rows

_PANELS = (
    Panel("held_out_log_likelihood", "log-likelihood of held-out measurements", "nats per point"),
    Panel("thickness", "thickness of the components", "metres", log=True),
    Panel("auc", "AUC, free points anywhere on the beam", "area under the ROC curve"),
    Panel("auc_near_surface", "AUC, free points near the surface", "area under the ROC curve"),
)


def figures(rows: Rows) -> dict[str, Figure]:
    """Draws `sensor_model`: log-likelihood, thickness and AUC of each variant against the bytes of its map.

    Args:
        rows: of `gmmtorch.evaluation.studies.sensor_noise`.
    """
    title = f"With and without a model of the sensor noise: {subject(rows)}"
    return {"sensor_model": panels_figure(rows, _PANELS, "variant", title, x="nbytes")}
