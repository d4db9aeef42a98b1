#!/usr/bin/env bash
# Builds the site into outputs/site, without a network; warnings are errors.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/python -m sphinx -W --keep-going -q -b html -d outputs/site/.doctrees docs outputs/site
echo "site: open outputs/site/index.html"
