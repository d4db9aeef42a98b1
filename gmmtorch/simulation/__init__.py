"""Simulated worlds, range sensors and sensor paths.

World frame: metres, z up. Sensor frame: x forward, y left, z up. All randomness comes from the
`torch.Generator` or the seed that the caller gives. Names are imported when they are first used.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
