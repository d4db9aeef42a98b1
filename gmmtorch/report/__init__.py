"""Output of a run: figures, tables, progress bars and TensorBoard events.

Figures use `matplotlib.figure.Figure` directly, without pyplot, windows or global state. This module imports
nothing, so a command loads only what it draws.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
