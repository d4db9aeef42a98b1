"""gmmtorch-view: shows a map in the browser, or writes it as one HTML file."""

from __future__ import annotations

import atexit
import functools
import logging
import sys
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common, schema
from gmmtorch.declarations import group, option
from gmmtorch.errors import InvalidArgumentError

if TYPE_CHECKING:
    from gmmtorch.live import LiveView, MapViewer

# Flags of Hydra whose values are words of their own.
_FLAGS_WITH_A_VALUE = {"--cfg", "-c", "--package", "-p", "--info", "-i", "--config-path", "-cp"}
_FLAGS_WITH_A_VALUE |= {"--config-name", "-cn", "--config-dir", "-cd"}


BOUNDS = "of a map in tiles: the box [x0,y0,z0,x1,y1,z1] (m), in 2D without z, that is opened; null: all"


@dataclass
class PageAddress:
    """Where a page in the browser is served."""

    host: str = option("127.0.0.1", "address of the page; 0.0.0.0: other machines can open it, too")
    port: int = option(8080, "port of the page; the next free one if it is in use")
    origins: list[str] = option(
        [],
        "list of addresses at which browsers find the page behind a proxy, such as https://map.example.org",
    )


@dataclass
class ViewOptions(PageAddress):
    """The view of a command's work in the browser."""

    view: bool = option(False, "show the work in the browser while it runs, and until Ctrl-C")


@dataclass
class PageOptions(PageAddress):
    """Options of gmmtorch-view."""

    path: str | None = option(None, "map file, run directory of gmmtorch-map, or folder of tiles")
    bounds: list[float] | None = option(None, BOUNDS)
    html: str | None = option(None, "file to write, .html, instead of serving a page")
    shape: str = option("splats", "splats, ellipsoids (2σ), surfaces (the mesh, in 3D) or none")
    colour: str = option(
        "height",
        "height, support, age (the order in which components were learned), uncertainty (of the surface), or "
        "a channel of the map, such as colour",
    )
    runtime: common.Memory = group(common.Memory)


@functools.cache
def register() -> None:
    """Stores the options of the command."""
    schema.store({"view": schema.schema_of(PageOptions)})


def main() -> None:
    """Entry point of the command."""
    sys.argv[1:] = overrides(sys.argv[1:])
    app.start("view", run, register)


def overrides(words: Sequence[str]) -> list[str]:
    """The arguments as Hydra's overrides: a FILE or folder becomes path=, and --html FILE becomes html=."""
    found: list[str] = []
    before = ""
    for word in words:
        if before == "--html":
            found.append(_assigned("html", word))
        elif word.startswith("--html="):
            found.append(_assigned("html", word.removeprefix("--html=")))
        elif before in _FLAGS_WITH_A_VALUE or word.startswith("-") or "=" in word:
            found += [] if word == "--html" else [word]
        else:
            found.append(_assigned("path", word))
        before = word
    return found


def _assigned(name: str, value: str) -> str:
    quoted = value.replace("\\", "\\\\").replace("'", "\\'")
    return f"{name}='{quoted}'"


def run(config: DictConfig) -> None:
    """Run the command. Without `html` it serves the page until it is interrupted."""
    from gmmtorch.cli import inputs
    from gmmtorch.cli.reporting import map_outputs
    from gmmtorch.live import MapViewer, write_page

    if not config.path:
        raise InvalidArgumentError("path is not set; give a map file or the run directory of gmmtorch-map.")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it reports every connection
    common.use_runtime(config.runtime)
    path = Path(config.path).expanduser()
    shown = inputs.open_map(path, config.runtime, config.bounds)
    trajectories = map_outputs.trajectories(path, shown.dim or 3)
    look = {"shape": config.shape, "colour": config.colour}
    if config.html:
        written = write_page(config.html, shown, trajectories, **look)
        print(f"{written}  {written.stat().st_size:,} bytes: open it in a browser")
        return
    place = {"host": config.host, "port": config.port, "origins": config.origins}
    serve(MapViewer(shown, trajectories, **look, **place))


def open_live_view(config: DictConfig) -> LiveView | None:
    """The view of a map that grows, whose address it prints; None without `view`."""
    if not config.view:
        return None
    from gmmtorch.live import LiveView

    logging.getLogger("websockets").setLevel(logging.WARNING)  # it reports every connection
    view = LiveView(config.host, config.port, config.origins)
    atexit.register(view.stop)  # a thread that computes while Python ends would abort the process
    print(f"The map is at {view.url}", flush=True)
    return view


def serve(viewer: MapViewer | LiveView) -> None:
    """Prints the address, waits until the user interrupts, and ends the page."""
    print(f"The map is at {viewer.url}. Ctrl-C ends.", flush=True)
    try:
        threading.Event().wait()
    finally:
        viewer.stop()


if __name__ == "__main__":
    main()
