"""gmmtorch-view: shows a map in the browser, or writes it as one HTML file."""

from __future__ import annotations

import atexit
import logging
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from gmmtorch.cli import app, common
from gmmtorch.cli.options import schema
from gmmtorch.errors import InvalidArgumentError

if TYPE_CHECKING:
    from gmmtorch.live import LiveView, MapViewer

# Flags of Hydra whose values are words of their own.
_FLAGS_WITH_A_VALUE = {"--cfg", "-c", "--package", "-p", "--info", "-i", "--config-path", "-cp"}
_FLAGS_WITH_A_VALUE |= {"--config-name", "-cn", "--config-dir", "-cd"}


def main() -> None:
    """Entry point of the command."""
    sys.argv[1:] = overrides(sys.argv[1:])
    app.start("view", run, schema.register)


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
    from gmmtorch.cli.from_options import maps
    from gmmtorch.cli.reporting import map_outputs
    from gmmtorch.live import MapViewer, write_page

    if not config.path:
        raise InvalidArgumentError("path is not set; give a map file or the run directory of gmmtorch-map.")
    logging.getLogger("websockets").setLevel(logging.WARNING)  # it reports every connection
    common.use_runtime(config.runtime)
    path = Path(config.path).expanduser()
    shown = maps.open_map(path, config.runtime, config.bounds)
    trajectories = map_outputs.trajectories(path, config.trajectory, shown.dim or 3)
    look = {"shape": config.shape, "colour": config.colour}
    if config.html:
        written = write_page(config.html, shown, trajectories, **look)
        print(f"{written}  {written.stat().st_size:,} bytes: open it in a browser")
        return
    serve(MapViewer(shown, trajectories, **look, host=config.host, port=config.port))


def open_live_view(config: DictConfig) -> LiveView | None:
    """The view of a map that grows, whose address it prints; None without `view`."""
    if not config.view:
        return None
    from gmmtorch.live import LiveView

    logging.getLogger("websockets").setLevel(logging.WARNING)  # it reports every connection
    with common.naming({"host": "view_host", "port": "view_port"}):
        view = LiveView(config.view_host, config.view_port)
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
