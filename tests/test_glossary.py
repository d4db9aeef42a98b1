"""docs/glossary.md names files that exist."""

from __future__ import annotations

import re
from pathlib import Path

import gmmtorch

PACKAGE = Path(gmmtorch.__file__).parent
GLOSSARY = PACKAGE.parent / "docs" / "glossary.md"


def test_glossary_names_existing_files():
    paths = re.findall(r"`([a-z_/]+(?:\.py|/))`", GLOSSARY.read_text(encoding="utf-8"))
    assert len(paths) > 40
    assert not [path for path in paths if not (PACKAGE / path).exists()]


def test_glossary_defines_each_term_once():
    terms = re.findall(r"^\| ([^|]+) \| [^|]+ \|", GLOSSARY.read_text(encoding="utf-8"), re.MULTILINE)
    terms = [term for term in terms if term not in ("term", "---")]
    assert len(terms) == len(set(terms)) > 50
