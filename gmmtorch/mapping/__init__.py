"""Maps of Gaussian components with their sensor origins (thesis 4.1).

Names are imported on first use.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from gmmtorch.lazy_names import lazy_names

if TYPE_CHECKING:
    from gmmtorch.mapping.clearance import Body as Body
    from gmmtorch.mapping.clearance import collision_probability as collision_probability
    from gmmtorch.mapping.clearance import expected_returns as expected_returns
    from gmmtorch.mapping.components import Components as Components
    from gmmtorch.mapping.gaussian_map import GaussianMap as GaussianMap
    from gmmtorch.mapping.learning.rules import IncrementalRule as IncrementalRule
    from gmmtorch.mapping.learning.rules import NoveltyRule as NoveltyRule
    from gmmtorch.mapping.learning.rules import WindowedRule as WindowedRule
    from gmmtorch.mapping.query_options import QueryOptions as QueryOptions
    from gmmtorch.mapping.tiles import TiledMap as TiledMap

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Body": "clearance",
        "Components": "components",
        "GaussianMap": "gaussian_map",
        "IncrementalRule": "learning.rules",
        "NoveltyRule": "learning.rules",
        "QueryOptions": "query_options",
        "TiledMap": "tiles",
        "WindowedRule": "learning.rules",
        "collision_probability": "clearance",
        "expected_returns": "clearance",
    },
)
