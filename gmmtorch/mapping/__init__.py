"""Maps of Gaussian components with their sensor origins (thesis 4.1).

Names are imported on first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
