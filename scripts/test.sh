#!/usr/bin/env bash
# Checks format, lint and types, and runs the tests that are not marked slow.
#   ./scripts/test.sh -m slow      runs the slow ones: subprocesses, compilation, soak
#   ./scripts/test.sh -m ""        runs all
# If GMMTORCH_DATA names a folder of real scans, the tests marked real_data run too.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/ruff format --check .
.venv/bin/ruff check .
.venv/bin/mypy
.venv/bin/pytest -n auto -m "not slow" "$@" # each test uses one thread; a later -m replaces the first
