"""The name of `gmmtorch.team.sharing` in version 1.0."""

import importlib
import sys

sys.modules[__name__] = importlib.import_module("gmmtorch.team.sharing")
