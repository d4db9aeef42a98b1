#!/usr/bin/env bash
# Format, lint, types, tests. With GMMTORCH_DATA set, the tests on real scans run, too.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/ruff format --check .
.venv/bin/ruff check .
.venv/bin/mypy
.venv/bin/pytest -n auto "$@"  # every test has one thread
