"""The name of `gmmtorch.experiments.baselines` in version 1.0."""

import importlib
import sys

sys.modules[__name__] = importlib.import_module("gmmtorch.experiments.baselines")
