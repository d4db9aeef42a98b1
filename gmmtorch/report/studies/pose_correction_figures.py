"""Figure of maps learned from noisy poses, before and after correction."""

from __future__ import annotations

from matplotlib.figure import Figure

from gmmtorch.report import style

_BARS = (("auc", "noisy poses"), ("auc_corrected", "noisy poses, corrected"), ("auc_clean", "true poses"))


def figures(rows: style.Rows) -> dict[str, Figure]:
    """Draws `pose_correction`, three bars per row: AUC with noisy poses, after correction, and with true
    poses.

    Args:
        rows: dataset, method, kept, resolution (m), pose_noise_m, pose_noise_rad, auc, auc_corrected,
            auc_clean.
    """
    figure = style.new_figure(2.4 + 2.4 * len(rows), 4.6)
    axes = figure.subplots()
    for number, (field, label) in enumerate(_BARS):
        places = [i + 0.27 * (number - 1) for i in range(len(rows))]
        bars = axes.bar(places, [row[field] for row in rows], 0.25, label=label, color=style.colour(number))
        axes.bar_label(bars, fmt="%.4f", padding=3, fontsize=style.TICK_SIZE - 1)
    names = [f"{style.label_of(row['method'])}, {style.metres(row['resolution'])}" for row in rows]
    kept = [f"{row['kept']:.0%} of the data" for row in rows]
    axes.set_xticks(range(len(rows)), [f"{a}\n{b}" for a, b in zip(names, kept, strict=True)])
    style.label_axes(axes, "", "", "area under the ROC curve")
    lowest = min(row[field] for row in rows for field, _ in _BARS)
    axes.set_ylim(max(0.0, lowest - 0.5 * (1 - lowest)), 1.0)
    style.legend_below(figure)
    noise = f"{style.metres(rows[0]['pose_noise_m'])}, {rows[0]['pose_noise_rad']:g} rad"
    style.figure_title(figure, f"Maps with pose noise of {noise}: {rows[0]['dataset']}")
    return {"pose_correction": figure}
