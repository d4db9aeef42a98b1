#!/usr/bin/env python
"""The command gmmtorch-team, from a checkout."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gmmtorch.team.cli.team import main

if __name__ == "__main__":
    main()
