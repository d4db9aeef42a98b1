#!/usr/bin/env bash
# Long runs of sharing: a thousand teams in trouble, 500 robots killed, a million hostile packets. Some 20
# minutes on two cores.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/python benchmarks/soak.py "$@"
