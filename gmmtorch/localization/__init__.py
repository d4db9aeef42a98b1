"""Registration of maps: the rigid motion that aligns one map with another.

Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.localization.registration import Registration as Registration
    from gmmtorch.localization.registration import register as register
    from gmmtorch.localization.registration import yaw_starts as yaw_starts

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {"Registration": "registration", "register": "registration", "yaw_starts": "registration"},
)
