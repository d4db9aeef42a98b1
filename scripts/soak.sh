#!/usr/bin/env bash
# Long runs of sharing: a thousand teams in trouble, 500 robots killed, a million hostile packets; then teams of
# processes that talk over UDP and are killed. An hour on two cores; options go to the first part.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/python benchmarks/soak.py "$@"
PYTHONPATH=tests .venv/bin/python -m exploration.kill_replay 30
.venv/bin/python benchmarks/udp_team.py --runs 20 --loss 0.3 --kill --scans 450 --settle 40
