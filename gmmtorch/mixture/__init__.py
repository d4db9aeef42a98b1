"""Gaussian mixtures: estimators, streamed fits, and reduction of mixtures (thesis chapter 2).

Names are imported on first use, so that one estimator does not load the others.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
