"""The site builds without a warning, its links lead somewhere, and every public name is described."""

from __future__ import annotations

import importlib
import importlib.util
import inspect
import re
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
MODULES = re.findall(r"automodule:: (\S+)", (DOCS / "api.rst").read_text("utf-8"))
COLUMNS = 90
"""The widest line of code that the site shows without scrolling. examples/ruff.toml has it too."""
LOADED = re.compile(r'<(?:script|img|link)\b[^>]*?(?:src|href)="([^"]*)"')
"""Addresses that a browser loads with a page. Icons and search descriptions are relative as well."""


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_is_whole(tmp_path, capsys):
    """Without pages of source code, and without running the tutorials, which tests/test_examples.py does."""
    pytest.importorskip("myst_nb", reason="needs the extra [docs]")
    build = pytest.importorskip("sphinx.cmd.build")
    changed = ["extensions=myst_nb,sphinx.ext.autodoc,sphinx.ext.napoleon", "nb_execution_mode=off"]
    changed += ["suppress_warnings=ref.python,myst-nb.lexer"]  # the kernel would name the language of a cell
    options = [word for setting in changed for word in ("-D", setting)]
    site, doctrees = tmp_path / "site", tmp_path / "doctrees"
    status = build.main(["-W", "--keep-going", "-q", *options, "-d", str(doctrees), str(DOCS), str(site)])
    assert status == 0, capsys.readouterr().err
    pages = {path: path.read_text("utf-8") for path in site.rglob("*.html")}
    assert len(pages) > 30
    assert not unnamed(pages[site / "api.html"])
    assert {"n_components", "reg_covar"} <= set(
        arguments(pages[site / "api.html"], "gmmtorch.GaussianMixture")
    )
    assert not broken_links(pages)
    assert not {
        address for page in pages.values() for address in LOADED.findall(page) if urlsplit(address).netloc
    }
    assert {"tutorials/ros", "occupancy"} <= set(re.findall(r'"([\w/]+)"', searched(site)))


def unnamed(api: str) -> list[str]:
    """Public names that the reference lacks."""
    documented = {name.rpartition(".")[2] for name in re.findall(r'id="(gmmtorch[\w.]+)"', api)}
    return [f"{name}.{item}" for name in MODULES for item in names(name) if item not in documented]


def arguments(api: str, name: str) -> list[str]:
    """The arguments that the reference lists for a class."""
    (heading,) = re.findall(rf'id="{re.escape(name)}">(.*?)</dt>', api, re.DOTALL)
    return re.findall(
        r'class="n"><span class="pre">(\w+)</span></span><span class="p"><span class="pre">:', heading
    )


def names(module: str) -> list[str]:
    """The public names of a module that are no modules themselves: those that the reference lists, or all."""
    section = (DOCS / "api.rst").read_text("utf-8").partition(f"automodule:: {module}\n")[2]
    listed = re.match(r"   :members: (.*)", section)
    public = listed[1].split(", ") if listed else importlib.import_module(module).__all__
    return [name for name in public if importlib.util.find_spec(f"{module}.{name}") is None]


def broken_links(pages: dict[Path, str]) -> list[str]:
    """Links between pages whose file or anchor does not exist."""
    anchors = {path: set(re.findall(r'\bid="([^"]+)"', page)) for path, page in pages.items()}
    broken = []
    for path, page in pages.items():
        for link in re.findall(r'<a\b[^>]*?href="([^"]*)"', page):
            parts = urlsplit(link.replace("&amp;", "&"))
            if parts.scheme:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            if not target.exists() or (anchor and target in anchors and anchor not in anchors[target]):
                broken.append(f"{path.name}: {link}")
    return broken


def searched(site: Path) -> str:
    """The names of the pages in the index of the search, which works without a server."""
    (pages,) = re.findall(r'"?docnames"?:\s*(\[[^\]]*\])', (site / "searchindex.js").read_text("utf-8"))
    return str(pages)


@pytest.mark.parametrize("module", MODULES)
def test_every_public_name_has_a_docstring(module):
    lacking = []
    for name in names(module):
        item = getattr(importlib.import_module(module), name)
        members = {"": item, **(vars(item) if inspect.isclass(item) else {})}
        for member, value in members.items():
            value = getattr(value, "__func__", value)  # of class methods
            if not member.startswith("_") and (
                isinstance(value, property) or inspect.isfunction(value) or not member
            ):
                described = inspect.getdoc(getattr(item, member) if member else item)
                lacking += [] if described or not callable(item) else [f"{name}.{member}"]
    assert not lacking


@pytest.mark.parametrize("page", [*ROOT.glob("*.md"), *DOCS.rglob("*.md")], ids=lambda page: page.stem)
def test_lines_of_code_are_as_wide_as_the_site_shows_them(page):
    blocks = re.findall(r"^```.*?^```", page.read_text("utf-8"), re.DOTALL | re.MULTILINE)
    assert not [line for block in blocks for line in block.splitlines() if len(line) > COLUMNS]


def test_every_page_is_in_the_table_of_contents():
    listed = re.findall(r"^([a-z_/]+)$", (DOCS / "index.md").read_text("utf-8"), re.MULTILINE)
    pages = [path for suffix in ("md", "rst") for path in DOCS.rglob(f"*.{suffix}")]
    written = {path.relative_to(DOCS).with_suffix("").as_posix() for path in pages}
    assert sorted(listed) == sorted(written - {"index"})


def test_the_numbers_of_the_summary_are_those_of_the_sections_it_links_to():
    text = (ROOT / "BENCHMARKS.md").read_text("utf-8")
    summary = text.split("<!-- summary -->")[1].split("<!-- /summary -->")[0]
    rows = re.findall(r"^\|(.*)\|(.*)\|(.*)\| \[\w+\]\(#([\w-]+)\) \|$", summary, re.MULTILINE)
    assert len(rows) == summary.strip().count("\n") - 1 <= 12
    sections = re.split(r"^##+ ", text, flags=re.MULTILINE)
    by_anchor = {part.split("\n")[0].lower().replace(" ", "-"): part for part in sections}
    for what, *sides, anchor in rows:
        missing = numbers(" ".join(sides)) - numbers(by_anchor[anchor])
        assert not missing, what


def numbers(text: str) -> set[str]:
    return {number.rstrip(",.") for number in re.findall(r"\d[\d,.]*", text)}
