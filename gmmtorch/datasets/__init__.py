"""Data sets of scans: log files, scan folders, meshes, and simulated buildings.

`load` opens a data set by name and imports its module only then. The other names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
