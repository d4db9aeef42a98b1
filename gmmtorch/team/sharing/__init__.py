"""The replicated map of a team, its store on disk, and the networks that carry its messages.

Names are imported when they are first used, so that `import gmmtorch.team.sharing` stays light.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
