"""Gaussian mixture maps from range data. The README gives a tour.

Names are imported on first use, so that `import gmmtorch` is fast.
"""

from importlib.metadata import PackageNotFoundError, version

import lazy_loader

try:
    __version__ = version("gmmtorch")
except PackageNotFoundError:  # a bare checkout on the path
    __version__ = "0+unknown"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
