"""What a recording contains, what of it would be mapped, and which options would help: check=true."""

from __future__ import annotations

import contextlib
import datetime
import logging
import sys
import textwrap
from collections.abc import Iterator, Mapping
from logging.handlers import BufferingHandler
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from gmmtorch import datasets
from gmmtorch.cli import inputs
from gmmtorch.datasets import NANOSECONDS, NO_POSE, BagFacts, BagReader, Dataset, bag_facts
from gmmtorch.errors import GmmTorchError, printable, told
from gmmtorch.report import Row, byte_text, count_text, format_table

_N_SAMPLES = 40  # scans that are read
_MOST_TRIALS = 12  # openings of the recording with other options
_N_TRIED = 5  # scans of each, of which one must have beams
_CLOCKS_DIFFER = 0.5  # s
_NEAREST, _FARTHEST = 0.03, 300.0  # m, of a usual median range
_FASTEST = 60.0  # m/s of a usual robot
_FEW_SCANS = 0.9  # share of scans below which other options are tried
_OPTIONS = {name: f"dataset.{name}" for name in ("poses", "motion")}
_DAY = 86_400.0  # s
_LONG_GAP, _MANY_PERIODS = 1.0, 5  # s, and periods of the scans
_MOVES = 0.05  # m of a path
_WIDTH = 110


def check(config: DictConfig) -> bool:
    """Prints what the data set `dataset.*` contains and would give; returns whether a map can be built."""
    options = config.dataset
    facts = _bag(options) if options.name == "rosbag" else None
    found, problem, share = None, "", 0.0
    advice = list(_clock_advice(facts)) if facts else []
    with _noted_warnings() as warnings:
        try:
            found = inputs.open_dataset(options)
            problem = "" if len(found) else f"{found.name} has no scan."
        except GmmTorchError as error:
            problem = str(error)
        if found is not None and not problem:
            share = _print_scans(found, advice)
        else:
            _print_wrapped("\nproblem    ", problem)
        if facts is not None and share < _FEW_SCANS:
            warnings = list(warnings)  # not those of the trials
            advice += _trials(options, facts, 0 if found is None else len(found), problem)
    others = _unread(facts, found) if share else []
    if others:
        _print_wrapped(
            "note       ",
            f"{', '.join(others)} would not be read; dataset.topic chooses a topic, or a list of several "
            "sensors of the robot",
        )
    for text in dict.fromkeys(record.getMessage() for record in warnings):
        if facts is None or not facts.damage or facts.damage not in text:  # it is printed already
            _print_wrapped("note       ", text)
    if share:
        print("\nresult     a map can be built: the same options without check=true build it")
    else:
        print("\nresult     no map can be built with these options")
    none = (
        "nothing looks wrong" if share else "no option that was tried helps; the problem says what is missing"
    )
    print("advice")
    for number, text in enumerate(advice or [none], 1):
        _print_wrapped(f"  {number}. ", text)
    return share > 0


def _unread(facts: BagFacts | None, found: Dataset | None) -> list[str]:
    """The topics of sensors that are not read."""
    read = str(getattr(found, "topic", "")).split(", ")
    sensors = [one.topic.name for one in facts.topics if one.use.startswith("scans")] if facts else []
    return [name for name in sensors if name not in read]


@contextlib.contextmanager
def _noted_warnings() -> Iterator[list[logging.LogRecord]]:
    """Collects the warnings of readers, which the console would have between the lines of the table."""
    logger, notes = logging.getLogger("gmmtorch"), BufferingHandler(sys.maxsize)
    notes.setLevel(logging.WARNING)
    consoles = {
        handler: handler.level
        for handler in logging.getLogger().handlers
        if not isinstance(handler, logging.FileHandler)
    }
    logger.addHandler(notes)
    for handler in consoles:
        handler.setLevel(logging.ERROR)
    try:
        yield notes.buffer
    finally:
        logger.removeHandler(notes)
        for handler, level in consoles.items():
            handler.setLevel(level)


def _print_wrapped(label: str, text: str) -> None:
    print(
        textwrap.fill(
            printable(text), _WIDTH, initial_indent=label, subsequent_indent=" " * len(label.lstrip("\n"))
        )
    )


def _bag(options: DictConfig) -> BagFacts | None:
    """The facts of a bag, printed; None if it cannot be read at all, which the data set's error explains."""
    path = Path(str(options.path)).expanduser()
    try:
        facts = bag_facts(BagReader(path))
    except GmmTorchError as error:
        _print_wrapped("\ndamage     ", f"the messages cannot be read: {error}")
        return None
    files = [path] if path.is_file() else sorted(file for file in path.rglob("*") if file.is_file())
    begin = datetime.datetime.fromtimestamp(facts.first / NANOSECONDS, datetime.UTC)
    n_messages = sum(one.topic.n_messages for one in facts.topics)
    print(
        f"\nrecording  {printable(str(path))}, {byte_text(sum(file.stat().st_size for file in files))}: "
        f"{count_text(n_messages, 'message')} in {(facts.last - facts.first) / NANOSECONDS:.1f} s from "
        f"{begin:%Y-%m-%d %H:%M:%S} UTC"
    )
    if facts.damage:
        _print_wrapped("damage     ", facts.damage)
    rows: list[Row] = [
        {
            "topic": printable(one.topic.name),
            "type": printable(one.topic.type).replace("/msg/", "/"),
            "messages": one.topic.n_messages,
            "per_second": one.rate,
            "longest_gap_s": one.gap,
            "stamp_age_s": _age(one.offset),
            "gives": printable(told(one.use, _OPTIONS)) or "nothing",
        }
        for one in facts.topics
    ]
    print(f"\n{format_table(rows)}" if rows else "\nIt has no topics.")
    if rows:
        _print_wrapped(
            "",
            "stamp_age_s: from the stamp of a message to its recording; sensors and poses whose ages differ "
            "have different clocks",
        )
    return facts


def _age(offset: float | None) -> float | str | None:
    if offset is None:
        return None
    return "another clock" if abs(offset) > _DAY else round(offset, 3) + 0.0


def _clock_advice(facts: BagFacts) -> Iterator[str]:
    """Warnings of sensors whose stamps are of another clock than those of the poses."""
    known = [one for one in facts.topics if one.offset is not None and one.use]
    poses = [one for one in known if one.use.startswith("poses") and not one.topic.name.endswith("static")]
    for sensor in (one for one in known if one.use.startswith("scans")):
        for other in poses[:1]:
            assert sensor.offset is not None
            assert other.offset is not None
            apart = sensor.offset - other.offset
            if abs(apart) > _CLOCKS_DIFFER:
                by = f"{abs(apart):,.1f} s" if abs(apart) < _DAY else f"{abs(apart) / _DAY:,.0f} days"
                yield (
                    f"stamps of {sensor.topic.name} and {other.topic.name} that were recorded together are "
                    f"{by} apart: their clocks differ, which dataset.clock=received may mend"
                )


def _print_scans(found: Dataset, advice: list[str]) -> float:
    """Prints facts about scans and poses, and adds what looks wrong; returns the share of usable scans."""
    n_scans = len(found)
    indices = torch.linspace(0, n_scans - 1, min(n_scans, _N_SAMPLES)).long().unique().tolist()
    scans, unread = [], []
    for index in indices:
        try:
            scans.append(found[index])
        except GmmTorchError as error:
            unread.append(str(error))
    n_left_out = sum(found.skipped.values())
    topic = getattr(found, "topic", "")
    usable = [scan for scan in scans if scan.n_beams]
    text = f"{n_scans:,} would be read{f' of {printable(topic)}' if topic else ''}"
    if found.n_sensors > 1:
        text += ", merged in the order of their times, each from the place of its own sensor"
    text += (f", in {usable[0].dim}D" if usable else "") + _timing(found, advice)
    _print_wrapped("\nscans      ", text)
    if usable:
        _print_ranges(usable, advice)
    else:
        advice.append(f"no points in {count_text(len(indices), 'scan')}: the map would be empty")
    _print_poses(found, advice)
    for reason, count in found.skipped.items():
        print(f"note       {count_text(count, 'scan')}: {printable(reason)}")
    for reason in dict.fromkeys(unread):
        _print_wrapped("note       ", f"a scan cannot be read: {reason}")
    share = len(usable) / max(len(indices), 1)
    n_whole = n_scans * found.stride
    return share * n_whole / (n_whole + n_left_out * (share == 1))


def _timing(found: Dataset, advice: list[str]) -> str:
    times = found.times
    if times is None or len(times) < 2:
        return ""
    steps = times.diff()
    middle, longest = float(steps.median()), float(steps.max())
    if longest > max(_LONG_GAP, _MANY_PERIODS * middle):
        begin = float(times[steps.argmax()] - times[0])
        advice.append(
            f"no scan for {longest:.1f} s from {begin:.1f} s on: the map lacks what was passed there"
        )
    rate = f" at {1 / middle:.1f} a second" if middle > 0 else ""
    return f"{rate}; the longest gap is {longest:.2f} s"


def _print_ranges(scans: list[Any], advice: list[str]) -> None:
    ranges = torch.cat([(scan.points - scan.origin).norm(dim=1).double() for scan in scans])
    counts = torch.tensor([len(scan.points) for scan in scans]).double()
    n_beams = sum(scan.n_beams for scan in scans)
    text = f"           {int(counts.median()):,} points in a scan (median of {len(scans)})"
    if len(ranges):
        low, middle, high = (float(ranges.sort().values[int(q * (len(ranges) - 1))]) for q in (0, 0.5, 1))
        text += f", {low:.2f} to {high:.1f} m away, half of them within {middle:.2f} m"
        if not _NEAREST < middle < _FARTHEST:
            advice.append(
                f"half of the points are within {middle:.3g} m, which is unusual: is the unit metres? "
                "dataset.depth_scale states the unit of depth images; convert other recordings"
            )
    if len(ranges) < n_beams:
        text += f"; {1 - len(ranges) / n_beams:.0%} of the beams have no return"
    print(text)


def _print_poses(found: Dataset, advice: list[str]) -> None:
    if found.pose(0) is None:
        print("poses      none in the data set")
        advice.append("the data set states no poses; estimate them: dataset.odometry=auto")
        return
    rows = [i for i in range(len(found)) if found.sensor_of(i) == 0]  # the path of one sensor
    poses = torch.stack([pose for i in rows if (pose := found.pose(i)) is not None])
    steps = poses[:, :-1, -1].diff(dim=0).norm(dim=1)
    n_without = -(-found.skipped.get(NO_POSE, 0) // found.stride)
    known = f"for {len(found):,} of {len(found) + n_without:,} scans" if n_without else "for all scans"
    text = f"poses      {known}; path of {float(steps.sum()):.1f} m"
    times = found.times
    if times is not None and len(rows) > 1:
        speed = float((steps / times[rows].diff().clamp_min(1e-3)).max())
        text += f", at most {speed:.1f} m/s"
        if speed > _FASTEST:
            advice.append(
                f"poses jump: {speed:,.0f} m/s between two scans; estimate them: dataset.odometry=mixture"
            )
    print(text)
    if float(steps.sum()) < _MOVES and len(poses) > 1:
        advice.append(
            "by its poses the sensor stands still; if it moved, estimate them: dataset.odometry=mixture"
        )


def _trials(options: DictConfig, facts: BagFacts, n_found: int, problem: str) -> list[str]:
    """Options with which more scans can be read, each tried on the recording; or what else than the problem
    stands in their way."""
    given = {str(key): options[key] for key in options if options[key] is not None}
    for name in ("name", "path", "odometry", "motion"):
        given.pop(name, None)
    sensors = [one.topic.name for one in facts.topics if one.use.startswith("scans")]
    topics: list[Mapping[str, Any]] = [{}]
    if options.topic is None and len(sensors) > 1:
        topics = [{"topic": sensors}, *({"topic": name} for name in sensors)]
    sources = [one.topic.name for one in facts.topics if one.use.startswith("poses, if")]
    changes: list[Mapping[str, Any]] = [
        {},
        *({"poses": name} for name in sources),
        {"clock": "received"},
        {"max_gap": 10.0},
        {"poses": "standing"},
    ]
    advice, n_trials, fault = [], 0, ""
    for chosen in topics:
        for change in changes:
            tried = {**chosen, **change}
            if not tried or n_trials == _MOST_TRIALS:
                continue
            n_trials += 1
            try:
                found = datasets.load("rosbag", options.path, **{**given, **tried})
                n_scans = len(found) if any(found[i].n_beams for i in range(min(len(found), _N_TRIED))) else 0
            except GmmTorchError as error:
                if change.get("poses") == "standing":
                    fault = str(error.told({name: f"dataset.{name}" for name in map(str, options)}))
                continue
            if n_scans > n_found:
                if change.get("poses") == "standing":
                    tried = {**chosen, "odometry": "auto"}
                words = " ".join(_override(name, value) for name, value in tried.items())
                note = " with poses estimated from the scans" if "odometry" in tried else ""
                advice.append(f"add {words}, which reads {count_text(n_scans, 'scan')}{note}")
                if not change or change.get("poses") in sources:
                    break
    is_other = fault not in ("", problem)
    return advice or ([f"with estimated poses there is another problem: {fault}"] if is_other else [])


def _override(name: str, value: Any) -> str:
    """An option as it is written on the command line; a list is quoted, as shells read brackets."""
    return f"'dataset.{name}=[{','.join(value)}]'" if isinstance(value, list) else f"dataset.{name}={value}"
