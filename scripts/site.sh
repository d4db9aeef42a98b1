#!/usr/bin/env bash
# Builds the site into outputs/site, without a network; warnings are errors. Runs the tutorials, which takes
# a minute or two. Links to other sites are not visited; external_links.txt lists them.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
.venv/bin/python -m sphinx -W --keep-going -q -b html -d outputs/site/.doctrees docs outputs/site
grep -rohE 'href="https?://[^"]+' outputs/site --include='*.html' | cut -c7- | sort -u > outputs/site/external_links.txt
echo "site: open outputs/site/index.html"
