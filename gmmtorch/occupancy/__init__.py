"""Evidence of hits and misses, and the occupancy that follows from it (thesis chapter 3).

Public names are imported when they are first used, so that `import gmmtorch.occupancy` stays light.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
