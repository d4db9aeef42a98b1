"""Measures again what README.md and docs/ claim: prints the claimed and the measured numbers, and what holds.

    python benchmarks/claims.py --list
    python benchmarks/claims.py --data FOLDER                # the quick runs: minutes
    python benchmarks/claims.py --data FOLDER --slow         # all runs: hours
    python benchmarks/claims.py --data FOLDER --only accuracy fig4_4

A run is a command whose output stays in a folder of --output. A finished run is not repeated, so that a check
that was stopped goes on with the rest. A claim has a page and a text on it, in which # stands for a number
and … for anything within the line; how the number is read from the output of the run; and the interval within
which the measured number must lie. The exit status is 1 if a claim does not hold, if a run fails, or if a
page does not have the text of a claim exactly once.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from claim_readers import (
    Interval,
    Reader,
    at_least,
    at_most,
    cell_texts,
    count_of_numbers,
    difference,
    joined,
    numbers,
    printed,
    published,
    ratio,
    reduced,
    result,
    score,
    section,
    times,
    within,
)
from pages import ROOT

from gmmtorch.experiments.harness import Table, markdown


class Claim(NamedTuple):
    """Numbers of a page, and how they are measured. Without a reader, the run itself checks them."""

    page: str  # or page#part, or a table of results
    text: str
    read: Reader | None = None
    intervals: Interval | Sequence[Interval] = within(0)  # one for all numbers of the text, or one for each


class Run(NamedTuple):
    """A command, with the data in $DATA and its output in $OUT, and the claims that it measures."""

    command: str
    claims: list[Claim]
    slow: bool = True  # over two minutes of one core


def of_table(mark: str, keys: int, columns: dict[str, Interval], *labels: Sequence[str]) -> list[Claim]:
    """A claim for each row of a table of results, or for those with the labels.

    The first `keys` cells of a row are its label; `columns` are those that are compared.
    """
    place, claims = f"{RESULTS}/{mark}.json", []
    for row in Table.load(ROOT / place).texts():
        label = tuple(list(row.values())[:keys])
        there = [name for name in columns if count_of_numbers(row.get(name, ""))]
        if not there or (labels and label not in labels):
            continue
        intervals = [columns[name] for name in there for _ in range(count_of_numbers(row[name]))]
        claims.append(Claim(place, cell_texts(row, keys, there), published(mark, label, *there), intervals))
    return claims


def auc(method: str, kept: float | tuple[float, ...] = 1.0, **where: float) -> Reader:
    return result("auc", method=method, kept=kept, **where)


def size(method: str, scale: float = 1e-3, **where: float) -> Reader:
    """Of the map of all beams: kB, or bytes times `scale`."""
    return result("nbytes", scale, method=method, kept=1.0, **where)


def team(field: str, framework: str = "gmm_shared", scale: float = 1.0) -> Reader:
    return result(field, scale, framework=framework)


def largest(*readers: Reader) -> Reader:
    return reduced(max, joined(*readers))


def saving(other: str, framework: str = "gmm_shared") -> Reader:
    """How many times fewer bytes a team sends than another team, or than another codec of its points."""
    more = team(other, framework) if other.startswith("bytes") else team("bytes_sent", other)
    return ratio(more, team("bytes_sent", framework))


def compact(name: str, components: str = "#") -> Claim:
    """A row of the table of compact maps."""
    ours = (result("n_components", method="point"), size("point"), auc("point"), auc("flux"))
    text = f"| {name} | {components}, # kB | # | # | count grid # ("
    return Claim(
        f"{RESULTS}/compact-maps.json",
        text,
        joined(*ours, auc("occupancy_grid")),
        [times(1.1), at_most(1.02), AUC, AUC, AUC],
    )


def sweep(method: str, dim: int) -> Reader:
    """The largest errors of misses and of θ on random scenes."""
    where = {"study": "sweep", "method": method, "dim": dim}
    return joined(result("misses_max", **where), result("probability_max", **where))


def of_team(framework: str, label: str, cell: str = "# ± …") -> Claim:
    """A row of the table of Fig 4.4."""
    fields = {"entropy_reduction_bits": 1e-3, "t50": 1.0, "t90": 1.0, "auc": 1.0, "cross_entropy_bits": 1.0}
    read = joined(*[team(field, framework, scale) for field, scale in fields.items()])
    text = f"| {label} | {' | '.join([cell] * 5)}"
    return Claim(
        f"{FIGURES}#Fig 4.4", text, read, [times(1.06), within(3), within(6), within(0.03), within(0.04)]
    )


def few_beams_2d(method: str, label: str, cell: str = "#") -> Claim:
    """A row of the table of Fig 3.4."""
    text = f"| {label} | {' | '.join([cell] * 4)} | # kB |"
    return Claim(
        f"{FIGURES}#Fig 3.4", text, joined(auc(method, FOUR), size(method)), [AUC] * 4 + [times(1.05)]
    )


def few_beams_3d(name: str, data: str) -> Run:
    """Three rows of the table of Fig 3.6."""
    text = "\n".join(
        f"| {label} |{' # |' * 6}…" for label in (f"**{name}**…: count grid", "Monte Carlo", "point")
    )
    read = joined(*[auc(method, SIX) for method in ("occupancy_grid", "monte_carlo", "point")])
    return Run(
        OCCUPANCY + "experiment=fig3_6_auc_sparsity_3d " + data,
        [Claim(f"{FIGURES}#Fig 3.6", text, read, AUC)],
    )


def of_mission(label: str) -> Reader:
    """The mean of E0 in a row of the table of exploration."""
    read = published("exploration", (label,), "E0")
    return lambda out: read(out)[:1]


def mission_row(label: str, interval: Interval) -> Claim:
    return Claim(f"{RESULTS}/exploration.json", f"| {label} | # …", of_mission(label), interval)


FIGURES, RESULTS = "docs/experiments.md", "benchmarks/results"
AUC, SIZE = within(0.003), times(1.05)
SIX, FOUR = (1.0, 0.5, 0.3, 0.2, 0.1, 0.05), (1.0, 0.3, 0.1, 0.05)

OCCUPANCY = "gmmtorch-occupancy hydra.run.dir=$OUT "
INTEL = "dataset=carmen dataset.path=$DATA/laser2d/intel.log.gz "
HALL = "dataset=scan_folder dataset.path=$DATA/hall "
COURTYARD = "dataset=scan_folder dataset.path=$DATA/courtyard "
MINE = "dataset=mesh_scans dataset.path=$DATA/meshes/edgar_mine.ply "
KINECT = "dataset=depth_frames dataset.path=$DATA/kinect dataset.pixel_stride=2 "
COMPACT = (
    OCCUPANCY + "evaluation.test_every=5 evaluation.max_beams=50000 'method=[occupancy_grid,point,flux]' "
)
PEAK = (
    'python -c "import numpy as np; made = np.random.default_rng(0).random((10**7, 3), np.float32); '
    "np.save('$OUT/cloud.npy', made)\" && python -c \"import resource, subprocess as s; "
    "s.run('gmmtorch-fit points=$OUT/cloud.npy mixture.n_components=50 mixture.max_iter=2 "
    "hydra.run.dir=$OUT', shell=True, check=True); "
    "print('peak', resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss // 1024, 'MiB')\""
)
ODOMETRY = "python benchmarks/odometry.py --data $DATA --only odometry --seeds 0 --methods"
SEEDS = "gmmtorch-explore hydra.run.dir=$OUT experiment=fig4_4_entropy 'study.seeds=[0,1,2,3,4]' "

LEARNED = {"times faster": times(2), "K": within(0), "held-out nats": within(0.02), "PSNR2 dB": within(0.5)}
CLOUDS = (
    "room, 20k points, K = 1000",
    "room, 100k points, K = 64",
    "a hall scan, K = 256",
    "a kinect frame, K = 50",
)
PEERS = [(cloud, "gmmtorch") for cloud in CLOUDS]
FASTER = joined(*[published("learning-1", peer, "times faster") for peer in PEERS])
SHORT = {"100 %": AUC, "30 %": AUC, "10 %": AUC, "grid": SIZE, "mixture": SIZE}
LONG = dict.fromkeys(("occupancy_grid", "occupancy_log_odds", "monte_carlo", "point"), score)
SMALL = [
    published("readme-accuracy", label, "mixture") for label in (("hall", "0.2 m"), ("kinect", "0.05 m"))
]
BUILT = {"frames/s": times(2), "AUC": within(0.001), "bytes": at_most(1.02)}
FAST = ("`cell=0.05, iterations=4, window=16, window_components=200`", "all")
LEADS = {"ours ahead, bytes a frame: octaves": times(1.3), "times fewer, at most": times(1.25)}
FOUND = {"within 0.1 m, 1°": within(5), "found, but over 0.5 m or 5°": within(0), "scans/s": at_least(0.5)}
RATES = [
    published("localization", (f"{name}, from 0.5 m and 10° off",), "scans/s") for name in ("hall", "intel")
]
ALIGNED = {"0.5 m, 10°": within(1), "error (m)": within(0.01), "align (s)": times(2), "bytes": SIZE}
FLOWN = {"ATE": times(1.5), "median step error": times(1.5), "steps off by over 0.2 m": within(0)}
HELD = ("ms", "ms with 20,000 components held")

# fmt: off
RUNS = {
    "snippet": Run("pytest -q -m slow tests/test_examples.py -k snippet_of_the_readme", [
        Claim("README.md", "median # on these surface points; 0.5 without evidence"),
    ], slow=False),
    "building": Run(OCCUPANCY, [
        Claim("README.md", "a count grid from all beams, # kB. Right: a map of # Gaussians, # kB",
              joined(size("occupancy_grid"), result("n_components", method="point"), size("point")), SIZE),
    ], slow=False),
    "fig3_3": Run(OCCUPANCY + "experiment=fig3_3_approximation_error", [
        Claim(FIGURES, "| thesis's cone (3.3), 2D | … | 3·10⁻⁴, # | # |", sweep("cone", 2), within(0.02)),
        Claim(FIGURES, "| thesis's projection …, 3D | … | 3·10⁻³, # | # |", sweep("cone", 3), within(0.02)),
        Claim(FIGURES, "| point form, 3D | … | 8·10⁻³, # | # |", sweep("point", 3), within(0.02)),
        Claim(FIGURES, "The flux form has errors of up to #·10⁻⁴ everywhere",
              largest(*[result("misses_max", 1e4, study="sweep", method="flux", dim=dim) for dim in (2, 3)]),
              at_most(1.1)),
    ], slow=False),
    "sharing_costs": Run("python benchmarks/sharing_costs.py", [
        *of_table("message-sizes", 1, {"bytes": SIZE}),
        *of_table("replica-costs", 1, dict.fromkeys(HELD, at_most(3))),
        *of_table("frame-costs", 1, {"time": at_most(3)}),
    ], slow=False),
    "viewing": Run("gmmtorch-map dataset=synthetic_building hydra.run.dir=$OUT && "
                   "gmmtorch-view $OUT --html $OUT/map.html", [
        Claim("docs/viewing.md", "The simulated hall: # components, # kB",
              joined(result("n_components"), result("nbytes", 1e-3)), SIZE),
        Claim("docs/viewing.md", "one file to send to a colleague: # kB for this map",
              ratio(printed("map.html  # bytes"), lambda out: [1000.0]), SIZE),
    ], slow=False),
    "deskewing": Run("python benchmarks/deskewing.py --data $DATA",
                     of_table("deskewing", 1, {"distance": within(0.3)}), slow=False),
    "large_cloud": Run(PEAK, [
        Claim("docs/large_clouds.md", "120 MB) needs # MiB of memory", printed("peak # MiB"), at_most(1.25)),
    ], slow=False),
    "map_building": Run("python benchmarks/map_building.py --data $DATA --only map-building", [
        *of_table("map-building", 2, BUILT),
        Claim("docs/maps.md", "[# frames of 640", published("map-building", FAST, "frames/s"), times(2)),
    ], slow=False),
    "compact_kinect": Run(COMPACT + KINECT + "'evaluation.resolution=[0.05]' map.max_bytes=8000",
                          [compact("kinect", "# components")], slow=False),
    "compact_hall": Run(COMPACT + HALL + "'evaluation.resolution=[0.2]' map.max_bytes=8000",
                        [compact("hall")], slow=False),
    "compact_courtyard": Run(COMPACT + COURTYARD + "'evaluation.resolution=[0.2]' map.max_bytes=16000",
                             [compact("courtyard")], slow=False),
    "learning": Run("python benchmarks/learning.py --data $DATA --only learning-1 "
                    "--methods gmmtorch scikit-learn", [
        Claim("README.md", "is [# to # times faster](",
              joined(reduced(min, FASTER), reduced(max, FASTER)), times(2)),
        *of_table("learning-1", 2, LEARNED, *PEERS),
    ]),
    "accuracy": Run("python benchmarks/accuracy.py --data $DATA --only accuracy readme-accuracy", [
        *of_table("readme-accuracy", 2, SHORT),
        *of_table("accuracy", 3, LONG),
        Claim("README.md", "keeps [a room or a hall in # kB]", largest(*SMALL), at_most()),
    ]),
    "rate_distortion": Run("python benchmarks/rate_distortion.py --data $DATA --figure $OUT/figure.png",
                           of_table("rate-distortion", 2, LEADS)),
    "localization": Run("python benchmarks/localization.py --data $DATA", [
        *of_table("localization", 1, FOUND),
        Claim("README.md", "[# times a second in 3D]", RATES[0], at_least(0.5)),
        Claim("docs/registration.md", "3D scans at # Hz and 2D scans at # Hz",
              joined(*RATES), at_least(0.5)),
    ]),
    "registration": Run("python benchmarks/registration.py --data $DATA --draws 3", [
        *of_table("registration-hall", 1, ALIGNED),
        *of_table("registration-courtyard", 1, ALIGNED),
    ]),
    "odometry": Run(f"{ODOMETRY} mixture --names intel freiburg-101 aces orebro seattle && "
                    f"{ODOMETRY} mixture --names hall courtyard street && "
                    f"{ODOMETRY} kiss_icp --names hall courtyard street",
                    of_table("odometry", 3, FLOWN)),
    "fig3_4": Run(OCCUPANCY + "experiment=fig3_4_auc_sparsity_2d " + INTEL, [
        Claim(FIGURES, "1 cm Monte Carlo has # […] with all beams, # […] with 70 % removed and # […] with",
              auc("monte_carlo", (1.0, 0.3, 0.05), resolution=0.01), AUC),
        Claim(FIGURES, "| intel | count grid | # | # | # |",
              auc("occupancy_grid", (1.0, 0.1, 0.05), resolution=0.01), AUC),
        Claim(FIGURES, "with 0.001 the point form has #, #, #, # there",
              auc("point", FOUR, resolution=0.1), AUC),
    ]),
    "fig3_4_prior_1": Run(
        OCCUPANCY + "experiment=fig3_4_auc_sparsity_2d map.prior=1 'evaluation.resolution=[0.1]' " + INTEL, [
            Claim(FIGURES, "at 10 cm Monte Carlo has # […], the grid # […]",
                  joined(auc("monte_carlo"), auc("occupancy_grid")), AUC),
            few_beams_2d("occupancy_grid", "count grid"),
            few_beams_2d("hilbert", "Hilbert map (sparse features)"),
            few_beams_2d("cone", "cone (3.3)"),
            few_beams_2d("monte_carlo", "Monte Carlo"),
            few_beams_2d("flux", "flux"),
            few_beams_2d("point", "**point**", "**#**"),
        ]),
    "fig3_6_hall": few_beams_3d("hall", HALL),
    "fig3_6_courtyard": few_beams_3d("courtyard", COURTYARD),
    "fig3_6_mine": few_beams_3d("mine", MINE),
    "fig4_4": Run(SEEDS + "'world.size=[24,20,5]'", [
        of_team("gmm_thesis", "E0 of the thesis (`gmm_thesis`)"),
        of_team("gmm_shared", "E0, ours (`gmm_shared`)", "**# ± …**"),
        of_team("grid_shared", "E1 (`grid_shared`)"),
        of_team("grid_isolated", "E2 (`grid_isolated`)"),
        Claim(FIGURES, "E0 removes # […] of our entropy, has its t90 # s […] later, and an AUC that is # […]",
              joined(ratio(team("entropy_reduction_bits", "gmm_thesis"), team("entropy_reduction_bits")),
                     difference(team("t90", "gmm_thesis"), team("t90")),
                     difference(team("auc"), team("auc", "gmm_thesis"))),
              [within(0.07), within(4), within(0.025)]),
        Claim(FIGURES, "The thesis's E0 sends # times fewer bytes than E1",
              saving("grid_shared", "gmm_thesis"), times(1.15)),
        Claim(FIGURES, "Ours sends # […] times fewer bytes than the thesis's E0, and # […] times fewer",
              joined(saving("gmm_thesis"), saving("grid_shared")), times(1.15)),
    ]),
    "exploration": Run("python benchmarks/missions.py --only exploration --missions $OUT/missions", [
        Claim("README.md", "they send # times fewer bytes than the raw points",
              ratio(of_mission("novel points, 12 B each (kB)"), of_mission("sent (kB)")), times(1.1)),
        Claim("docs/exploration.md", "E0 sends # times fewer bytes than … from, and # times fewer than Draco",
              joined(*[ratio(of_mission(label), of_mission("sent (kB)"))
                       for label in ("novel points, 12 B each (kB)", "the same by Draco (kB)")]), times(1.1)),
        Claim("docs/exploration.md",
              "An octree of the points' cells takes # times E0's bytes with zstd, # times with contexts",
              joined(*[ratio(of_mission(f"the same as an octree, {code} (kB)"), of_mission("sent (kB)"))
                       for code in ("zstd", "contexts")]), times(1.1)),
        mission_row("entropy taken away (kbit)", times(1.02)),
        mission_row("AUC, all observable cells", within(0.006)),
        mission_row("cross-entropy (bits a cell)", within(0.02)),
        mission_row("t90 (s)", within(40)),
        mission_row("sent (kB)", times(1.08)),
        mission_row("the same as an octree, contexts (kB)", times(1.08)),
        mission_row("on the wire, with headers (kB)", times(1.08)),
    ]),
    "soak": Run("python benchmarks/soak.py", [
        Claim(f"{RESULTS}/soak.json",
              "| schedules; all replicas equal at last; holding … | 1,000; 1,000; 1,000 |"),
    ]),
}
# fmt: on


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--data", type=Path, default=os.environ.get("GMMTORCH_DATA"))
    parser.add_argument("--output", type=Path, default=ROOT / "outputs" / "claims")
    parser.add_argument("--only", nargs="+", metavar="RUN", choices=list(RUNS))
    parser.add_argument("--slow", action="store_true", help="the slow runs, too")
    parser.add_argument("--again", action="store_true", help="repeat runs that are finished")
    parser.add_argument("--list", action="store_true", help="print runs and claims; measure nothing")
    options = parser.parse_args()
    names = options.only or [name for name, run in RUNS.items() if options.slow or not run.slow]
    if options.list:
        for name in options.only or RUNS:
            print(f"\n{name}{' (slow)' if RUNS[name].slow else ''}: {RUNS[name].command}")
            print(*[f"    {claim.page}: {claim.text}" for claim in RUNS[name].claims], sep="\n")
        return 0
    if options.data is None:
        parser.error("--data or the environment variable GMMTORCH_DATA must name the folder of data sets.")
    rows = []
    for name in names:
        finished = measure(
            name, Path(options.data).resolve(), (options.output / name).resolve(), options.again
        )
        rows += [checked(claim, options.output / name if finished else None) for claim in RUNS[name].claims]
    print(markdown(["page", "claim", "claimed", "measured", "holds"], rows))
    failed = sum(row[-1] != "yes" for row in rows)
    print(f"\n{len(rows) - failed} of {len(rows)} claims hold.")
    return 1 if failed else 0


def measure(name: str, data: Path, out: Path, again: bool) -> bool:
    """Runs a command unless it is finished; returns whether it is."""
    if (out / "done").exists() and not again:
        return True
    out.mkdir(parents=True, exist_ok=True)
    (out / "done").unlink(missing_ok=True)
    print(f"{name}: {RUNS[name].command}", file=sys.stderr, flush=True)
    folders = {"OUT": str(out), "DATA": str(data), "GMMTORCH_TABLES": str(out), "GMMTORCH_DATA": str(data)}
    begin = time.monotonic()
    with (out / "stdout").open("w") as output, (out / "stderr").open("w") as errors:
        status = subprocess.run(
            ["bash", "-c", RUNS[name].command],
            cwd=ROOT,
            env={**os.environ, **folders, "OMP_NUM_THREADS": "1"},
            stdout=output,
            stderr=errors,
        ).returncode
    took = f"{time.monotonic() - begin:.0f} s"
    print(f"{name}: {f'exit status {status}, see {out}' if status else 'finished'}, {took}", file=sys.stderr)
    if not status:
        (out / "done").write_text(took)
    return not status


def checked(claim: Claim, out: Path | None) -> list[str]:
    """A row of the table, with what a run wrote to a folder, or None if it failed."""
    start = [claim.page.split("#")[0], " ".join(claim.text.replace("|", "¦").split())[:90]]
    try:
        claimed = numbers(claim.text, section(claim.page))
    except ValueError as error:
        return [*start, "", "", f"no: {error}"]
    shown = ", ".join(f"{value:g}" for value in claimed)
    if out is None:
        return [*start, shown, "", "no: the run failed"]
    if claim.read is None:
        return [*start, shown, "by the run itself", "yes"]
    try:
        measured = claim.read(out)
        if len(measured) != len(claimed):
            raise ValueError(f"the run has {len(measured)} numbers, the page {len(claimed)}")
    except (ValueError, OSError) as error:  # the output lacks what the page has
        return [*start, shown, "", f"no: {error}"]
    intervals = claim.intervals if isinstance(claim.intervals, Sequence) else [claim.intervals] * len(claimed)
    wrong = []
    for interval, said, found in zip(intervals, claimed, measured, strict=True):
        low, high = interval(said)
        if not low <= found <= high:
            wrong.append(f"{found:.5g} is not in {low:.5g} … {high:.5g}")
    found_text = ", ".join(f"{value:.5g}" for value in measured)
    return [*start, shown, found_text, "no: " + "; ".join(wrong) if wrong else "yes"]


if __name__ == "__main__":
    sys.exit(main())
