"""The site builds without a network and without a warning, and documents every public name."""

from __future__ import annotations

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
MODULES = re.findall(r"automodule:: (\S+)", (DOCS / "api.rst").read_text("utf-8"))


@pytest.mark.slow
def test_the_site_builds_without_a_warning_and_has_every_public_name(tmp_path):
    pytest.importorskip("myst_nb", reason="needs the extra [docs]")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html"]
    done = subprocess.run(
        [*command, "-d", str(tmp_path / "doctrees"), str(DOCS), str(tmp_path / "site")],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "site" / "api.html").read_text("utf-8")
    documented = {name.rpartition(".")[2] for name in re.findall(r'id="(gmmtorch[\w.]+)"', page)}
    assert MODULES
    for name in MODULES:
        public = set(importlib.import_module(name).__all__)
        assert not {item for item in public if not is_module(name, item)} - documented, name


def is_module(package: str, name: str) -> bool:
    """Whether a public name of a package is a module."""
    return importlib.util.find_spec(f"{package}.{name}") is not None


def test_every_page_is_in_the_table_of_contents():
    listed = re.findall(r"^([a-z_/]+)$", (DOCS / "index.md").read_text("utf-8"), re.MULTILINE)
    pages = {path.relative_to(DOCS).with_suffix("") for path in DOCS.rglob("*.*") if path.suffix in (".md", ".rst")}
    assert sorted(listed) == sorted(page.as_posix() for page in pages - {Path("index")})
