#!/usr/bin/env python
"""The command gmmtorch-ros, from a checkout."""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from gmmtorch.team.cli.ros import main

if __name__ == "__main__":  # the processes of a study import this file
    main()
