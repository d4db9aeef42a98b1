"""Fused kernels of the hot loops, for CPU and CUDA from one source.

Each file holds one loop: the fused kernel, its twin in batched tensor operations, and the function that
chooses. The twin defines the result, carries gradients, and runs where the kernel compiler is missing.
"""

from gmmtorch.kernels.choice import KERNELS as KERNELS
from gmmtorch.kernels.choice import kernels as kernels
from gmmtorch.kernels.choice import use_kernels as use_kernels

__all__ = ["KERNELS", "kernels", "use_kernels"]
