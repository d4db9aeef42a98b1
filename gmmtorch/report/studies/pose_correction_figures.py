"""Maps learned from wrong poses, before and after they are put right."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report.style import (
    LABEL_SIZE,
    TICK_SIZE,
    Rows,
    colour,
    dress,
    figure_title,
    label_of,
    metres,
    new_figure,
)

_BARS = (("auc", "poses wrong"), ("auc_corrected", "components moved"), ("auc_clean", "poses right"))


def figures(rows: Rows) -> dict[str, Figure]:
    """`pose_correction`: three bars a row: AUC with wrong poses, once corrected, and with right ones.

    Args:
        rows: dataset, method, kept, resolution (m), pose_noise_m, pose_noise_rad, auc, auc_corrected,
            auc_clean.
    """
    figure = new_figure(2.4 + 2.4 * len(rows), 4.6)
    axes = figure.subplots()
    for number, (field, label) in enumerate(_BARS):
        values = [row[field] for row in rows]
        bars = axes.bar([i + 0.27 * (number - 1) for i in range(len(rows))], values, 0.25, label=label)
        for bar, value in zip(bars, values, strict=True):
            bar.set_color(colour(number))
            axes.annotate(
                f"{value:.4f}",
                (bar.get_x() + bar.get_width() / 2, value),
                xytext=(0, 3),
                textcoords="offset points",
                ha="center",
                fontsize=TICK_SIZE - 1,
            )
    axes.set_xticks(
        range(len(rows)),
        [f"{label_of(row['method'])}, {metres(row['resolution'])}\n{row['kept']:.0%} kept" for row in rows],
    )
    dress(axes, "", "", "area under the ROC curve")
    lowest = min(row[field] for row in rows for field, _ in _BARS)
    axes.set_ylim(max(0.0, lowest - 0.5 * (1 - lowest)), 1.0)
    figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=LABEL_SIZE)
    first = rows[0]
    noise = f"{metres(first['pose_noise_m'])}, {first['pose_noise_rad']:g} rad"
    figure_title(figure, f"Pose noise of {noise}, corrected: {first['dataset']}")
    return {"pose_correction": figure}
