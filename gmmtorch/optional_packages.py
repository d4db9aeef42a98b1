"""Loads third-party packages that may be missing, and explains how to install them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from gmmtorch.errors import GmmTorchError


def load_open3d(failure: str) -> Any:
    """The module open3d. Raises `GmmTorchError`, which starts with `failure`, if it does not load."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise GmmTorchError(
            f"{failure}, because Open3D does not load: {error}. On Debian or Ubuntu install libusb-1.0-0 "
            "libgl1 libegl1 libx11-6 libudev1 libgomp1 libidn2-0 (scripts/setup.sh does this)."
        ) from error
    return open3d


@contextmanager
def needs_extra(purpose: str, package: str, extra: str, note: str = "") -> Iterator[None]:
    """For imports: raises `GmmTorchError` if they fail, which names the extra of gmmtorch to install.

    Args:
        purpose: beginning of the message, as in "OctoMap needs".
        note: end of the message, with a leading space.
    """
    try:
        yield
    except ImportError as error:
        raise GmmTorchError(
            f"{purpose} the package {package}, which does not load ({error}); install it: "
            f"pip install 'gmmtorch[{extra}]'.{note}"
        ) from error


def load_pyoctomap() -> Any:
    """The module pyoctomap. Raises `GmmTorchError` if it does not load."""
    with needs_extra("OctoMap needs", "pyoctomap", "baselines"):
        import pyoctomap
    return pyoctomap


def load_ray() -> Any:
    """The module ray. Raises `GmmTorchError` if it does not load."""
    with needs_extra("Several workers and clusters need", "ray", "cluster"):
        import ray
    return ray
