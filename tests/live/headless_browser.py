"""A headless Chromium, driven through chromedriver's WebDriver interface (W3C)."""

from __future__ import annotations

import base64
import io
import json
import re
import shutil
import subprocess
import time
import urllib.request
from collections.abc import Callable
from typing import Any

import numpy as np
from PIL import Image

_OPTIONS = ["--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1000,700"]
_OPTIONS += ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_OPTIONS += ["--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"]  # no network beyond this machine


def is_installed() -> bool:
    """Whether Chromium and its driver are on this machine."""
    return shutil.which("chromedriver") is not None and shutil.which("chromium") is not None


class Browser:
    """A browser without a window; use it in a `with` statement."""

    def __enter__(self) -> Browser:
        self._process = subprocess.Popen(
            ["chromedriver", "--port=0"], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        assert self._process.stdout is not None
        port = next(
            found[1] for line in self._process.stdout if (found := re.search(r"on port (\d+)\.", line))
        )
        self._address = f"http://127.0.0.1:{port}/session"
        asked = {
            "browserName": "chrome",
            "goog:chromeOptions": {"binary": shutil.which("chromium"), "args": _OPTIONS},
            "goog:loggingPrefs": {"browser": "ALL"},
        }
        try:
            session = self._call("", {"capabilities": {"alwaysMatch": asked}})["sessionId"]
        except OSError:
            self._end()
            raise
        self._address += f"/{session}"
        return self

    def __exit__(self, *_: object) -> None:
        try:
            request = urllib.request.Request(self._address, method="DELETE")
            urllib.request.urlopen(request, timeout=30).close()
        finally:
            self._end()

    def _end(self) -> None:
        self._process.terminate()
        self._process.wait(timeout=30)
        assert self._process.stdout is not None
        self._process.stdout.close()

    def _call(self, name: str, content: dict[str, Any] | None = None) -> Any:
        data = None if content is None else json.dumps(content).encode()
        request = urllib.request.Request(self._address + name, data, {"Content-Type": "application/json"})
        with urllib.request.urlopen(request, timeout=120) as answer:
            return json.load(answer)["value"]

    def open(self, url: str) -> None:
        self._call("/url", {"url": url})

    def run(self, script: str, *arguments: Any) -> Any:
        """The value that a script returns in the page."""
        return self._call("/execute/sync", {"script": script, "args": list(arguments)})

    def errors(self) -> list[str]:
        """Severe messages of the console since the last call."""
        return [m["message"] for m in self._call("/se/log", {"type": "browser"}) if m["level"] == "SEVERE"]

    def picture(self) -> np.ndarray:
        """The page as RGB (H, W, 3)."""
        data = base64.b64decode(self._call("/screenshot"))
        return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)

    def wait(self, condition: Callable[[np.ndarray], bool], seconds: float = 60.0) -> np.ndarray:
        """The picture of the page as soon as it satisfies a condition."""
        end = time.monotonic() + seconds
        while not condition(picture := self.picture()):
            assert time.monotonic() < end, "the page does not show what is expected"
            time.sleep(0.3)
        return picture
