#!/usr/bin/env bash
# The main jobs on embedded data: a map from a recording of a simulated hall; maps of a 2D and of a 3D
# building, by mixture and by grid, scored on scans that neither was shown; and three robots that explore a
# warehouse and share their mixtures.
# Prints tables, and where the pictures are.
set -euo pipefail
cd "$(dirname "$0")/.."

./scripts/setup.sh
OUT="outputs/demo"
rm -rf "$OUT"
begin=$(date +%s)
mkdir -p "$OUT"
.venv/bin/python - "$OUT/recording.mcap" <<'PYTHON'
import sys

from gmmtorch import datasets
from gmmtorch.export import write_bag

hall = datasets.load("synthetic_building")
print("recording", write_bag(sys.argv[1], list(hall), [hall.pose(i) for i in range(len(hall))]))
PYTHON
.venv/bin/gmmtorch-map dataset=rosbag dataset.path="$OUT/recording.mcap" 'export=[map_server]' \
  hydra.run.dir="$OUT/map" "$@"
.venv/bin/gmmtorch-view "$OUT/map" --html "$OUT/map/map.html"
.venv/bin/gmmtorch-occupancy dataset=synthetic_building_2d 'evaluation.resolution=[0.1,0.02]' \
  'evaluation.kept=[1.0,0.3,0.1]' hydra.run.dir="$OUT/2d" "$@"
.venv/bin/gmmtorch-occupancy dataset=synthetic_building evaluation.test_every=5 \
  'evaluation.resolution=[0.1]' 'evaluation.kept=[1.0,0.3,0.1]' hydra.run.dir="$OUT/3d" "$@"
.venv/bin/gmmtorch-fit mixture.n_components=100 hydra.run.dir="$OUT/fit" "$@"
.venv/bin/gmmtorch-explore 'world.size=[30,24,6]' duration=100 'evaluation.codecs=[octree,draco]' \
  hydra.run.dir="$OUT/explore" "$@"
echo
echo "demo: done in $(($(date +%s) - begin)) s. Look at $OUT/map, $OUT/2d, $OUT/3d, $OUT/fit and $OUT/explore, or run"
echo "  .venv/bin/tensorboard --logdir $OUT"
