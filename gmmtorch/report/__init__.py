"""What a run shows: figures, tables, progress bars and a TensorBoard run.

Figures are built on `matplotlib.figure.Figure` alone: no pyplot, no window, no global state. Nothing is
imported here, so that a command loads no more than what it shows.
"""
