"""Fused kernels of the hot loops, for CPU and CUDA from one source.

Each file holds one loop: the fused kernel, its twin in batched tensor operations, and the function that
chooses. The twin defines the result, carries gradients, and runs where the kernel compiler is missing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
