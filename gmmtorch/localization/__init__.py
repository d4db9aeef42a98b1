"""Where a sensor or a map is: registration of two maps, and the poses of scans in a map, and
odometry.

Names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
