#!/usr/bin/env python
"""The command gmmtorch-robot, from a checkout."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gmmtorch.team.cli.robot import main

if __name__ == "__main__":
    main()
