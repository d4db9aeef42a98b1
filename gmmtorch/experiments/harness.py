"""Cases: comparisons of the package with its peers on named data, and the tables of results that they write.

A case names its data, its methods (ours and the peers) and its measure, which yields rows. Two commands run
cases. `run` is that of a script in benchmarks/: it writes each table as JSON after each row, so that a killed
run keeps what it has measured, and `benchmarks/pages.py` makes the tables of the pages from these files. The
experiments of gmmtorch-fit and gmmtorch-occupancy (`cli.studies`) take their options from Hydra, and draw
figures.
"""

from __future__ import annotations

import argparse
import inspect
import json
import multiprocessing
import os
import platform
import resource
import shlex
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy
import sklearn
import torch

from gmmtorch.datasets import Dataset, load
from gmmtorch.experiments.evaluation import FREE, OCCUPIED, Queries, roc
from gmmtorch.files import write_bytes

__all__ = [
    "Case",
    "Row",
    "Table",
    "alone",
    "clock",
    "cpu_seconds",
    "held_out",
    "least_seconds",
    "markdown",
    "recording",
    "run",
    "score",
]

Cell = float | str | None
Row = Mapping[str, Cell] | Sequence[Cell]
T = TypeVar("T")


def hardware(device: str = "cpu") -> str:
    """The machine and the versions, in a line; with the GPU, if `device` is one."""
    model = platform.processor() or platform.machine()
    cpu_info = Path("/proc/cpuinfo")
    if cpu_info.exists():
        lines = cpu_info.read_text().splitlines()
        names = [line.split(":")[1].strip() for line in lines if "model name" in line]
        model = names[0] if names else model
    gpu = "" if device == "cpu" else f"{torch.cuda.get_device_name(device)}; "
    return (
        f"{gpu}{model}, {os.cpu_count()} cores, {torch.get_num_threads()} thread(s) used; "
        f"torch {torch.__version__}, scikit-learn {sklearn.__version__}, "
        f"numpy {numpy.__version__}, Python {platform.python_version()}"
    )


@dataclass
class Table:
    """The results of a case.

    Attributes:
        about: what the cells are, and facts of the whole table.
        command: what measures them. hardware: where they were measured.
        columns: the format of the numbers of each column, in their order: of `format`, such as ".4f"; with
            braces of `str.format`, such as "{:.1f} mm"; "3" for three digits.
        rows: cells in the order of the columns. Text is shown as it is, None as nothing.
    """

    about: str
    command: str
    hardware: str
    columns: dict[str, str]
    rows: list[list[Cell]] = field(default_factory=list)

    @classmethod
    def load(cls, path: Path) -> Table:
        return cls(**json.loads(path.read_text(encoding="utf-8")))

    def save(self, path: Path) -> None:
        """Writes the table atomically, a line for each row."""
        values = asdict(self)
        rows = ",\n".join(f"  {json.dumps(row, ensure_ascii=False)}" for row in values.pop("rows"))
        lines = [f" {json.dumps(key)}: {json.dumps(values[key], ensure_ascii=False)}," for key in values]
        write_bytes(path, "\n".join(["{", *lines, ' "rows": [', rows, " ]", "}\n"]).encode())

    def texts(self) -> list[dict[str, str]]:
        """The cells of each row as they are shown, by column."""
        return [
            {name: shown(cell, form) for (name, form), cell in zip(self.columns.items(), row, strict=True)}
            for row in self.rows
        ]

    def markdown(self, chosen: Mapping[str, Collection[str]] | None = None) -> str:
        """A Markdown table of the rows whose cells in the columns `chosen` are among the values."""
        rows = [
            row for row in self.texts() if all(row[name] in values for name, values in (chosen or {}).items())
        ]
        return markdown(list(self.columns), [list(row.values()) for row in rows])


def shown(cell: Cell, form: str) -> str:
    """A cell as text."""
    if cell is None or isinstance(cell, str | bool):
        return "" if cell is None else str(cell)
    if form == "3":
        return three_digits(cell)
    return form.format(cell) if "{" in form else format(cell, form)


def three_digits(value: float) -> str:
    """The value with three significant digits, never as a power of ten above 1."""
    return f"{value:.3g}" if abs(value) < 1000 else f"{float(f'{value:.3g}'):,.0f}"


def markdown(header: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    names = list(header)
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


class Case(NamedTuple):
    """A comparison.

    Attributes:
        name: of its file of results and of its table in a page. "{threads}" in it stands for the number of
            threads, "{gpu}" for nothing, or "-gpu" on a GPU.
        measure: yields the rows for the options of the command. Of a script, `options.names` and
            `options.methods` are the chosen of `data` and `methods`, and text in `options.about` is added to
            `about`. An experiment gets a `cli.studies.Setting`.
        about: what the cells are.
        columns: with their formats, see `Table`. If rows are dictionaries, these name the columns, and only
            those with numbers have a format here.
        data: names of data sets. methods: names of ours and of the peers.
        key: the number of columns that name a row.
        needs_data: whether `options.data` must be a folder of recordings.
        figures: makes the figures of the rows of an experiment, by file name.
        shown: the rows of the printed table of an experiment.
        line: the field that names the curve of a row in TensorBoard. step: the field with its step; "": the
            index of the row.
    """

    name: str
    measure: Callable[[Any], Iterable[Any]]
    about: str = ""
    columns: Mapping[str, str] = {}
    data: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    key: int = 1
    needs_data: bool = True
    figures: Callable[[list[dict[str, Any]]], Mapping[str, Any]] = lambda rows: {}
    shown: Callable[[list[dict[str, Any]]], list[dict[str, Any]]] = lambda rows: rows
    line: str = "method"
    step: str = ""

    def file(self, device: str, threads: int) -> str:
        """The name of its file of results."""
        return self.name.format(threads=threads, gpu="" if device == "cpu" else "-gpu")


def run(text: str, *cases: Case, **arguments: dict[str, Any]) -> None:
    """The command of a script: measures its cases and writes a table of each.

    Args:
        text: of `--help`.
        arguments: more options by name, with what `ArgumentParser.add_argument` takes.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawTextHelpFormatter)
    data = os.environ.get("GMMTORCH_DATA")
    if any(case.needs_data for case in cases):
        parser.add_argument("--data", type=Path, default=data and Path(data), help="folder of recordings")
    for option, values in (
        ("--names", {name: None for case in cases for name in case.data}),
        ("--methods", {name: None for case in cases for name in case.methods}),
        ("--only", {case.file("cpu", 1): None for case in cases}),
    ):
        if len(values) > 1:
            parser.add_argument(option, nargs="+", choices=list(values), metavar="NAME", default=list(values))
    common: dict[str, dict[str, Any]] = {"threads": {"type": int, "default": 1}, "device": {"default": "cpu"}}
    for name, settings in {**common, **arguments}.items():
        parser.add_argument(f"--{name.replace('_', '-')}", **settings)
    options = parser.parse_args()
    options.is_whole = all(getattr(options, name) == parser.get_default(name) for name in arguments)
    chosen = [
        case for case in cases if case.file("cpu", 1) in getattr(options, "only", (case.file("cpu", 1),))
    ]
    if any(case.needs_data for case in chosen) and options.data is None:
        parser.error("--data or the environment variable GMMTORCH_DATA must name the folder of recordings.")
    with _threads(options.threads):
        for case in chosen:
            result = measured(case, options)
            print(
                f"\n{case.file(options.device, options.threads)}: {result.about}\n{result.markdown()}",
                flush=True,
            )


def measured(case: Case, options: argparse.Namespace) -> Table:
    """Measures a case, and writes its table after each row."""
    given = {name: getattr(options, name, None) for name in ("names", "methods")}
    options = argparse.Namespace(**vars(options))
    options.names = [name for name in case.data if given["names"] is None or name in given["names"]]
    options.methods = [name for name in case.methods if given["methods"] is None or name in given["methods"]]
    options.about = ""
    path = results_of(case) / f"{case.file(options.device, options.threads)}.json"
    table = Table("", command_line(), hardware(options.device), {})
    kept: dict[tuple[Cell, ...], dict[str, Cell]] = {}
    if path.exists():
        earlier = Table.load(path)
        if earlier.hardware == table.hardware:
            rows = (dict(zip(earlier.columns, row, strict=True)) for row in earlier.rows)
            kept = {_key(case, row): row for row in rows}

    def write(rows: Collection[dict[str, Cell]]) -> None:
        names = dict.fromkeys(name for row in rows for name in row)
        table.columns = {name: case.columns.get(name, "") for name in names}
        table.rows = [[row.get(name) for name in names] for row in rows]
        table.about = " ".join(filter(None, (options.about, case.about)))
        table.save(path)

    new = {}
    for cells in case.measure(options):
        row = dict(cells if isinstance(cells, Mapping) else zip(case.columns, cells, strict=True))
        print(*(shown(cell, case.columns.get(name, "")) for name, cell in row.items()), sep=" | ", flush=True)
        new[_key(case, row)] = row
        write((kept | new).values())
    is_whole = options.names == list(case.data) and options.methods == list(case.methods) and options.is_whole
    if new and is_whole:
        write(new.values())  # rows that are not measured any more go
    return table


def _key(case: Case, row: dict[str, Cell]) -> tuple[Cell, ...]:
    return tuple(list(row.values())[: case.key])


def results_of(case: Case) -> Path:
    """The folder of the results: `results` beside the script, or that which GMMTORCH_TABLES names."""
    return Path(os.environ.get("GMMTORCH_TABLES") or Path(inspect.getfile(case.measure)).parent / "results")


def command_line() -> str:
    """This command, with the folder of recordings as a variable."""
    data, folder = os.environ.get("GMMTORCH_DATA"), Path(sys.argv[0])
    words = [f"{folder.resolve().parent.name}/{folder.name}", *sys.argv[1:]]
    if "--data" in words:
        data = words[words.index("--data") + 1]
    return " ".join(["python", *("$GMMTORCH_DATA" if word == data else shlex.quote(word) for word in words)])


def recording(data: Path, name: str, **options: Any) -> Dataset:
    """A 2D log, frames of a depth camera, or a folder of 3D scans, by its name below the folder."""
    log = data / "laser2d" / f"{name}.log.gz"
    if log.is_file():
        return load("carmen", log, **options)
    return load("depth_frames" if name == "kinect" else "scan_folder", data / name, **options)


def held_out(dataset: Dataset) -> int:
    """Every how many scans one is held out: of 2D logs, which have more, every tenth."""
    return 10 if dataset[0].dim == 2 else 5


def score(answer: Any, asked: Queries, resolution: float) -> float:
    """AUC of the answers of a map."""
    theta = torch.as_tensor(answer.occupancy(asked.points, resolution))
    return roc(theta[asked.of(OCCUPIED)], theta[asked.of(FREE)]).auc


@contextmanager
def _threads(n: int) -> Iterator[None]:
    """Limits torch, and the libraries of NumPy and scikit-learn, to n threads."""
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    torch.set_num_threads(n)
    with threadpool_limits(n):
        yield


def cpu_seconds(work: Callable[[], T]) -> tuple[float, T]:
    """Processor seconds of all threads, and the result. Other programs do not add to them."""
    begin = time.process_time()
    result = work()
    return time.process_time() - begin, result


def clock() -> float:
    """Processor seconds with one thread; else those of a clock on the wall."""
    return time.process_time() if torch.get_num_threads() == 1 else time.perf_counter()


def least_seconds(work: Callable[[], object], repeats: int, device: str = "cpu") -> float:
    """The least time of several runs of the work, each until the device has ended it."""
    times = []
    for _ in range(repeats):
        begin = time.perf_counter()
        work()
        if device != "cpu":
            torch.cuda.synchronize()
        times.append(time.perf_counter() - begin)
    return min(times)


def alone(work: Callable[..., dict[str, Any]], *arguments: Any, limit: int | None = None) -> dict[str, Any]:
    """The result of a function in a process of its own; {"error": …} if it fails or takes too long.

    limit: seconds of the processor for each thread.
    """
    context = multiprocessing.get_context("spawn")
    here, there = context.Pipe()
    process = context.Process(target=_child, args=(work, arguments, torch.get_num_threads(), limit, there))
    process.start()
    there.close()
    try:
        found: dict[str, Any] = here.recv()
    except EOFError:  # the system has ended it
        found = {"error": f"over {limit} s" if limit else "ended by the system"}
    process.join()
    return found


def _child(work: Callable[..., Any], arguments: Any, threads: int, limit: int | None, pipe: Any) -> None:
    if limit:
        resource.setrlimit(resource.RLIMIT_CPU, (threads * limit, threads * limit))
    with _threads(threads):
        try:
            pipe.send(work(*arguments))
        except Exception as error:  # a peer's failure is a result, and is published
            pipe.send({"error": f"{type(error).__name__}: {str(error).splitlines()[0][:60]}"})
