"""The HTML file and the served page of a map in a real browser: what its picture shows, and its controls."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from headless_browser import Browser, is_installed

from gmmtorch.datasets import load
from gmmtorch.live.map_page import write_page
from gmmtorch.mapping.gaussian_map import GaussianMap

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not is_installed(), reason="needs chromium and chromedriver"),
]

_SCENE = np.s_[160:, :660]
"""Pixels of a page without controls and notifications."""

_SET = """
const [name, value] = arguments, control = document.getElementById(name);
if (typeof value === "boolean") control.checked = value; else control.value = value;
control.dispatchEvent(new Event("input"));
"""
_OPEN = """
[...document.querySelectorAll("input")].find((input) => input.value === "height").click();
"""
_CHOOSE = """
const option = [...document.querySelectorAll("[role=option]")].find((one) => one.textContent === "age");
if (option) option.click();
return Boolean(option);
"""
_TICK = """
[...document.querySelectorAll("label")].find((one) => one.textContent === "trajectory").click();
"""
_DRAG = """
const canvas = document.getElementById("canvas");
const at = (x) => ({ pointerId: 1, clientX: x, clientY: 300, buttons: 1, bubbles: true });
canvas.setPointerCapture = () => {};
canvas.dispatchEvent(new PointerEvent("pointerdown", at(300)));
canvas.dispatchEvent(new PointerEvent("pointermove", at(420)));
canvas.dispatchEvent(new PointerEvent("pointerup", at(420)));
"""


@pytest.fixture(scope="module")
def shown() -> tuple[GaussianMap, list[torch.Tensor]]:
    """A map of a room, and the sensor's path."""
    torch.set_num_threads(1)
    scans, built = load("synthetic_building", n_scans=6), GaussianMap()
    for scan in scans:
        built.insert(scan.select(torch.arange(scan.n_beams) % 4 == 0))
    return built, [torch.stack([scan.origin for scan in scans])]


def orange(picture: np.ndarray) -> int:
    """Number of pixels with the colour of the path."""
    red, green, blue = np.moveaxis(picture[_SCENE], 2, 0)
    return int(((red > green + 80) & (green > blue + 50)).sum())


def coloured(picture: np.ndarray) -> int:
    """Number of saturated pixels of the scene."""
    scene = picture[_SCENE]
    return int((scene.max(2) - scene.min(2) > 60).sum())


def test_controls_of_the_html_file_change_its_picture(shown, tmp_path):
    page = write_page(tmp_path / "map.html", *shown)
    with Browser() as browser:
        browser.open(f"file://{page}")
        browser.run(_SET, "slice", False)
        first = browser.wait(lambda picture: coloured(picture) > 20_000 and orange(picture) > 200)
        browser.run(_SET, "colour", "age")
        by_age = browser.wait(lambda picture: np.abs(picture - first)[_SCENE].max(2).mean() > 3)
        assert browser.run("return document.getElementById('most').textContent") == "newest"
        browser.run(_SET, "path", False)
        browser.wait(lambda picture: orange(picture) < 0.1 * orange(by_age))
        browser.run(_SET, "size", 0.5)
        browser.wait(lambda picture: coloured(picture) < 0.7 * coloured(by_age))
        browser.run(_SET, "shape", "none")
        empty = browser.wait(lambda picture: coloured(picture) == 0)
        browser.run(_SET, "slice", True)
        browser.wait(lambda picture: (picture != empty)[_SCENE].any(2).mean() > 0.02)
        browser.run(_SET, "shape", "splats")
        soft = browser.wait(lambda picture: coloured(picture) > 1000)
        browser.run(_DRAG)
        browser.wait(lambda picture: (picture != soft)[_SCENE].any(2).mean() > 0.02)
        assert browser.run("return performance.getEntriesByType('resource').length") == 0
        assert browser.errors() == []


def test_the_html_file_of_surfaces_has_their_mesh(shown, tmp_path):
    page = write_page(tmp_path / "map.html", *shown, shape="surfaces")
    with Browser() as browser:
        browser.open(f"file://{page}")
        browser.run(_SET, "slice", False)
        grey = browser.wait(lambda picture: (picture[_SCENE].max(2) < 210).mean() > 0.05)
        assert coloured(grey) < 0.1 * (grey[_SCENE].max(2) < 210).sum()
        assert browser.errors() == []


def test_the_served_page_shows_the_map_by_height_and_by_age(shown):
    pytest.importorskip("viser")
    from gmmtorch.live.map_viewer import MapViewer

    viewer = MapViewer(*shown, port=8397)
    try:
        with Browser() as browser:
            browser.open(viewer.url)
            first = browser.wait(lambda picture: coloured(picture) > 20_000 and orange(picture) > 100, 120)
            browser.run(_OPEN)
            browser.wait(lambda _: browser.run(_CHOOSE))
            browser.wait(lambda picture: np.abs(picture - first)[_SCENE].max(2).mean() > 3)
            assert viewer._colour.value == "age"
            browser.run(_TICK)
            browser.wait(lambda picture: orange(picture) < 0.2 * orange(first))
    finally:
        viewer.stop()
