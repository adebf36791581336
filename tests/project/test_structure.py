"""The package's structure: no cycles between modules or folders, few modules at the root."""

import ast
from collections.abc import Iterable, Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

from tests.helpers import ROOT

PACKAGE = ROOT / "surgical_marl"
MOST_MODULES = 8


def test_no_module_imports_itself_by_way_of_others() -> None:
    check_acyclic(imports())


def test_no_folder_imports_itself_by_way_of_others() -> None:
    folders: dict[str, set[str]] = {}
    for module, others in imports().items():
        inside = folders.setdefault(folder(module), set())
        inside |= {folder(other) for other in others} - {folder(module)}
    check_acyclic(folders)


def test_the_root_holds_few_modules() -> None:
    assert len(names := sorted(path.name for path in PACKAGE.glob("*.py"))) <= MOST_MODULES, names


def imports() -> dict[str, set[str]]:
    """What each module imports from the package, within functions and for type checkers too."""
    files = {module_name(path): path for path in PACKAGE.rglob("*.py") if path.name != "__init__.py"}
    return {name: set(found(path, files)) for name, path in files.items()}


def module_name(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def found(path: Path, modules: Iterable[str]) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in modules)
        if isinstance(node, ast.ImportFrom) and node.module:
            assert not node.level, f"{path}: a relative import"
            for name in (node.module, *(f"{node.module}.{alias.name}" for alias in node.names)):
                if name in modules:
                    yield name


def folder(module: str) -> str:
    """The package's folder that holds a module: modules at the root are folders of their own."""
    return ".".join(module.split(".")[:2])


def check_acyclic(graph: dict[str, set[str]]) -> None:
    try:
        tuple(TopologicalSorter(graph).static_order())
    except CycleError as error:
        raise AssertionError(" -> ".join(reversed(error.args[1]))) from None
