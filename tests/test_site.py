"""What holds the pages together: tables made from the content, links that lead somewhere, names that are described."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest

import surgical_marl as sm

from .helpers.pages import FENCE, PAGES, ROOT

LINK = re.compile(r"\[(?:[^\]`]|`[^`]*`)*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+ (.*)$", re.MULTILINE)


@pytest.fixture(scope="module")
def tables() -> Any:
    spec = importlib.util.spec_from_file_location("tables_of_content", ROOT / "docs" / "theme" / "tables.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_tables_are_those_of_the_content(tables: Any) -> None:
    pages = tables.pages()
    for page in pages:
        text = page.read_text(encoding="utf-8")
        assert tables.written(text) == text, f"{page.name} is out of date: python docs/theme/tables.py"
    marks = {name for page in pages for _, name, _ in tables.MARKED.findall(page.read_text(encoding="utf-8"))}
    assert marks == set(tables.TABLES)


def test_a_table_has_all_names_and_no_empty_column(tables: Any) -> None:
    lines = tables.scenes().splitlines()
    assert [line.split("`")[1] for line in lines[2:]] == sm.list_scenes()
    assert tables.table(["a", "b", "c"], iter([["1", "", "3"], ["4", "", "6"]])).splitlines()[0] == "| a | c |"
    assert tables.sites(["tip", "peg_0", "peg_1", "peg_2"]) == "`tip`, `peg_0` to `peg_2`"


@pytest.mark.parametrize("page", PAGES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_the_links_of_a_page_lead_somewhere(page: Path) -> None:
    for target in LINK.findall(without_code(page)):
        name, _, anchor = target.partition("#")
        if ":" in target:
            continue
        path = (page.parent / name) if name else page
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path), target


def without_code(page: Path) -> str:
    return FENCE.sub("", page.read_text(encoding="utf-8"))


def anchors(page: Path) -> set[str]:
    """The names of a page's headings, as both mkdocs and code hosts make them."""
    titles = (re.sub(r"[`*]|\]\([^)]*\)|\[", "", title) for title in HEADING.findall(without_code(page)))
    return {re.sub(r"[^\w\- ]", "", title.lower()).strip().replace(" ", "-") for title in titles}


def test_the_reference_describes_every_public_name() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md"))
    described = re.findall(r"^::: (\S+)$", text, re.MULTILINE)
    assert set(sm.__all__) <= {name.rpartition(".")[2] for name in described}
    for name in described:
        module, _, last = name.rpartition(".")
        assert getattr(importlib.import_module(module), last).__doc__, name


def test_the_readmes_speeds_are_those_of_the_benchmarks() -> None:
    _, _, rest = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Speed")
    rows = [row for row in rest.partition("##")[0].splitlines() if row.startswith("|")][2:]
    figures = [figure for row in rows for figure in re.findall(r"\d[\d,.]*\d", row.split("|")[4])]
    measured = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    assert len(figures) >= len(rows) > 5
    assert not [figure for figure in figures if figure not in measured]


def test_the_comparison_has_our_own_figures() -> None:
    text = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8")
    measured = (ROOT / "docs" / "benchmarks.md").read_text(encoding="utf-8")
    ours = [row.split("|")[2] for row in text.splitlines() if row.startswith("| surgical-marl,")]
    assert len(ours) == 3 and all(" ".join(row.split()[:2]) in measured for row in ours)
    (tasks,) = (row.split("|")[2].strip() for row in text.splitlines() if row.startswith("| tasks registered"))
    assert int(tasks) == len(sm.list_tasks())


def test_every_algorithm_has_its_place_in_the_page() -> None:
    text = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    shipped = [path.stem for path in (ROOT / "surgical_marl" / "learning" / "algorithms").glob("[!_]*.py")]
    assert shipped and all(f"| `{name}` |" in text for name in shipped)


def test_the_site_loads_nothing_from_elsewhere() -> None:
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "font: false" in settings and "://" not in settings and "analytics" not in settings
    theme = [path for path in (ROOT / "docs" / "theme").iterdir() if path.suffix in (".css", ".js")]
    assert len(theme) == 2 and not any("://" in path.read_text(encoding="utf-8") for path in theme)
