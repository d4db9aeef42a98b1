"""Occupancy maps from the literature, behind the same protocol as `GaussianMap`.

Names are imported when they are first used. See docs/baselines.md.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
