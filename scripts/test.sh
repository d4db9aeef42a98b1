#!/usr/bin/env bash
# Checks format, lint and types, and runs the tests that are not marked slow.
#   ./scripts/test.sh -m slow      runs the slow ones: subprocesses, compilation, soak
#   ./scripts/test.sh -m ""        runs all
# If GMMTORCH_DATA names a folder of real scans, the tests marked real_data run too.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/ruff format --check .
find gmmtorch -name '*.h' -exec .venv/bin/clang-format --dry-run --Werror {} +
.venv/bin/ruff check .
.venv/bin/mypy &
PACKAGE=$!
.venv/bin/mypy --config-file benchmarks/mypy.ini
wait "$PACKAGE"
status=0
# Each test uses one thread. A later -m replaces the first.
.venv/bin/pytest -n auto --dist worksteal -m "not slow" "$@" || status=$?
if [ "$status" = 1 ]; then
  echo "test: the tests that failed run once more, one at a time; those that fail again fail the run"
  .venv/bin/pytest --last-failed --last-failed-no-failures none -m "not slow" "$@"
else
  exit "$status"
fi
