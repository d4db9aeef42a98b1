"""Loads third-party packages that may be missing, and explains how to install them."""

from __future__ import annotations

from typing import Any

from gmmtorch.errors import GmmTorchError


def load_open3d(failure: str) -> Any:
    """The module open3d. Raises `GmmTorchError`, which starts with `failure`, if it does not load."""
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise GmmTorchError(
            f"{failure}, because Open3D does not load: {error}. On Debian or Ubuntu install libusb-1.0-0 "
            "libgl1 libegl1 libx11-6 libudev1 libgomp1 (scripts/setup.sh does this)."
        ) from error
    return open3d


def load_pyoctomap() -> Any:
    """The module pyoctomap. Raises `GmmTorchError` if it does not load."""
    try:
        import pyoctomap
    except ImportError as error:
        raise GmmTorchError(
            f"OctoMap needs the package pyoctomap, which does not load ({error}); install it: "
            "pip install 'gmmtorch[baselines]'."
        ) from error
    return pyoctomap


def load_viser() -> Any:
    """The module viser. Raises `GmmTorchError` if it does not load."""
    try:
        import viser
    except ImportError as error:
        raise GmmTorchError(
            f"The browser viewer needs the package viser, which does not load ({error}); install it: "
            "pip install 'gmmtorch[viewer]'."
        ) from error
    return viser


def load_ray() -> Any:
    """The module ray. Raises `GmmTorchError` if it does not load."""
    try:
        import ray
    except ImportError as error:
        raise GmmTorchError(
            f"Several workers and clusters need the package ray, which does not load ({error}); install it: "
            "pip install 'gmmtorch[cluster]'."
        ) from error
    return ray
