"""Fused kernels of the hot loops, for CPU and CUDA from one source.

A fused kernel is a C++ function in a `.h` file. The Python file beside it has the function that launches the
kernel, and its twin in batched tensor operations, or says where the twin is. The twin defines the result,
carries gradients, and runs where the kernel compiler is missing.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
