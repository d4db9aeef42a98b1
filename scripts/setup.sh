#!/usr/bin/env bash
# Makes .venv with everything gmmtorch needs, at the tested versions. Safe to run again.
set -euo pipefail
cd "$(dirname "$0")/.."

PYTHON="${PYTHON:-python3}"
STAMP=.venv/.gmmtorch-setup
PACKAGES="libusb-1.0-0 libgl1 libegl1 libx11-6 libudev1 libgomp1 libidn2-0"

if ! "$PYTHON" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2])'; then
  echo "setup: $("$PYTHON" --version) is too old; set PYTHON to a Python of 3.11 or newer." >&2
  exit 1
fi
if [ ! -x .venv/bin/python ]; then
  "$PYTHON" -m venv .venv || { echo "setup: python3-venv is missing; on Debian or Ubuntu: apt-get install python3-venv" >&2; exit 1; }
fi

# Installed already, from these very files?
WANTED="$(cat pyproject.toml constraints.txt | sha256sum | cut -d' ' -f1)"
if [ "$(cat "$STAMP" 2>/dev/null || true)" != "$WANTED" ]; then
  echo "setup: installing into .venv (a few minutes the first time)"
  # torch first and alone: a later resolution then finds the pinned build in place.
  TORCH="$(grep -E '^torch==' constraints.txt)"
  .venv/bin/python -m pip install --quiet --disable-pip-version-check "$TORCH" -c constraints.txt
  .venv/bin/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -c constraints.txt
  echo "$WANTED" > "$STAMP"
fi

# Open3D's wheel needs a few system libraries that bare machines lack.
if ! .venv/bin/python -c 'import open3d' 2> .venv/open3d-error.txt; then
  if [ "$(id -u)" = 0 ] && command -v apt-get > /dev/null; then
    echo "setup: installing the system libraries that Open3D needs: $PACKAGES"
    apt-get update -qq > /dev/null
    # shellcheck disable=SC2086  # a list of packages
    DEBIAN_FRONTEND=noninteractive apt-get install -y -qq $PACKAGES > /dev/null
    .venv/bin/python -c 'import open3d'
  else
    tail -n 1 .venv/open3d-error.txt >&2
    echo "setup: Open3D does not load. On Debian or Ubuntu: sudo apt-get install -y $PACKAGES" >&2
    echo "setup: without it no scans can be simulated in meshes; all else works." >&2
  fi
fi
rm -f .venv/open3d-error.txt
echo "setup: done; commands are in .venv/bin, such as .venv/bin/gmmtorch-occupancy --help"
