"""What holds the pages together: tables made from the content, links that lead somewhere, names that are described."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from typing import Any

import pytest
import yaml

import surgical_marl as sm
from tests.helpers.pages import FENCE, PAGES, ROOT

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


def test_a_figure_stands_in_one_place_and_is_set_into_the_others(tables: Any) -> None:
    """Each is used, and is written nowhere by hand."""
    texts = {page: page.read_text(encoding="utf-8") for page in PAGES}
    used = {name for text in texts.values() for _, name, _ in tables.FIGURE.findall(text)}
    assert used == set(tables.figures())
    assert all(len(tables.FIGURE.findall(text)) == text.count("<!-- figure:") for text in texts.values())
    runs = yaml.safe_load((ROOT / "docs" / "figures.yaml").read_text(encoding="utf-8"))
    for name, value in (figure for run in runs for figure in run["figures"].items()):
        alone = re.compile(rf"(?<![\d.,]){re.escape(value)}(?!\d)")
        pages = [page.name for page, text in texts.items() if alone.search(tables.FIGURE.sub("", text))]
        assert not pages, f"{pages} have {value!r}: write <!-- figure: {name} --><!-- end --> there"


def test_it_is_counted_who_imitated_the_oracle(tables: Any) -> None:
    configs = [yaml.safe_load((ROOT / "policies" / name / "config.yaml").read_text()) for name in sm.list_policies()]
    imitated = sum(bool((config.get("imitation") or {}).get("steps")) for config in configs)
    assert tables.figures()["imitated"] == f"{imitated} of {len(configs)}" and 0 < imitated < len(configs)


def test_the_speeds_of_readme_and_comparison_are_figures(tables: Any) -> None:
    _, _, rest = (ROOT / "README.md").read_text(encoding="utf-8").partition("## Speed")
    rows = [row for row in rest.partition("##")[0].splitlines() if row.startswith("|")][2:]
    text = (ROOT / "docs" / "comparison.md").read_text(encoding="utf-8")
    rows += [row for row in text.splitlines() if row.startswith("| surgical-marl,")]
    assert len(rows) > 10 and all(tables.FIGURE.search(row) for row in rows)


def test_every_algorithm_has_its_place_in_the_page() -> None:
    text = (ROOT / "docs" / "algorithms.md").read_text(encoding="utf-8")
    shipped = [path.stem for path in (ROOT / "surgical_marl" / "learning" / "algorithms").glob("[!_]*.py")]
    assert shipped and all(f"| `{name}` |" in text for name in shipped)


def test_the_site_loads_nothing_from_elsewhere() -> None:
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    assert "font: false" in settings and "://" not in settings and "analytics" not in settings
    theme = [path for path in (ROOT / "docs" / "theme").iterdir() if path.suffix in (".css", ".js")]
    assert len(theme) == 2 and not any("://" in path.read_text(encoding="utf-8") for path in theme)


def test_files_and_modules_that_pages_name_exist() -> None:
    """Files are named from the top of the repository, those of the package from its own top too."""
    places = (ROOT, ROOT / "surgical_marl")
    tops = "|".join(sorted(path.name for place in places for path in place.iterdir() if path.is_dir()))
    for page in PAGES:
        text = FENCE.sub("", page.read_text(encoding="utf-8"))
        files = re.findall(rf"`((?:{tops})/[\w./-]+\.(?:py|ya?ml|md))`", text)
        modules = re.findall(r"`((?:surgical_marl|docs\.studies)(?:\.[a-z]\w*)+)(?:\.[A-Z]\w*)*`", text)
        missing = [name for name in files if not any((place / name).exists() for place in places)]
        missing += [name for name in modules if not is_module_or_in_one(name)]
        assert not missing, f"{page.relative_to(ROOT)} names {', '.join(missing)}, which is not there"


def is_module_or_in_one(name: str) -> bool:
    """Return whether a dotted name is a module or a folder, a name in one's text, or a task's such as reach_v0."""
    path, parent = ROOT.joinpath(*name.split(".")), ROOT.joinpath(*name.split(".")[:-1])
    if path.is_dir() or path.with_suffix(".py").is_file() or re.fullmatch(r"\w+_v\d+", path.name):
        return True
    source = parent / "__init__.py" if parent.is_dir() else parent.with_suffix(".py")
    return source.is_file() and path.name in source.read_text(encoding="utf-8")
