"""What an installation carries, what an import costs, and how JAX is started."""

from __future__ import annotations

import ast
import importlib.metadata
import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml
from hatchling.builders.wheel import WheelBuilder

import surgical_marl as sm
from surgical_marl import runtime
from tests.helpers import ROOT


def run_python(code: str, **env: str) -> str:
    """What the code prints, in a fresh process without settings of JAX but those given."""
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("JAX_", "XLA_", "PJRT_"))}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, cwd=ROOT, env={**clean, **env}, capture_output=True, text=True, check=True)
    return done.stdout


def test_importing_the_package_and_the_command_line_imports_nothing_heavy() -> None:
    code = "import surgical_marl, surgical_marl.cli.main, sys; print(*sys.modules)"
    loaded = set(run_python(code).split())
    assert not loaded & {"jax", "torch", "mujoco", "yourdfpy", "warp", "matplotlib"}


def test_a_wheel_carries_code_and_content(tmp_path: Path) -> None:
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["standard"])
    names = set(zipfile.ZipFile(wheel).namelist())
    assert {
        "surgical_marl/cli/main.py",
        "surgical_marl/py.typed",
        "surgical_marl/content/arms/psm/arm.yaml",
        "surgical_marl/content/arms/psm/psm.urdf",
        "surgical_marl/content/scenes/bimanual_psm.yaml",
        "surgical_marl/content/configs/reach.yaml",
    } <= names
    roots = {name.split("/")[0] for name in names}
    assert roots == {"surgical_marl", f"surgical_marl-{sm.__version__}.dist-info"}


def test_citation_and_changelog_have_the_version_of_the_package() -> None:
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"]
    newest = re.search(r"^## (\S+)", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert newest and {cited, newest[1]} == {sm.__version__}


def test_an_editable_install_carries_no_copy(tmp_path: Path) -> None:
    (wheel,) = WheelBuilder(str(ROOT)).build(directory=str(tmp_path), versions=["editable"])
    names = zipfile.ZipFile(wheel).namelist()
    assert not [name for name in names if name.startswith("surgical_marl/")]


def test_every_dependency_is_pinned() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    wanted = [
        *project["dependencies"],
        *extras["test"],
        *extras["docs"],
        *extras["tune"],
        *extras["view"],
        *extras["supply"],
    ]
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    pins = {line.split("==")[0].lower() for line in lines if not line.startswith("#")}
    for requirement in wanted:
        name = requirement.split("[")[0].split(">")[0].split("=")[0].strip()
        assert name.lower() in pins, name


def test_every_import_is_declared() -> None:
    trees = [ast.parse(path.read_text()) for path in (ROOT / "surgical_marl").rglob("*.py")]
    nodes = [node for tree in trees for node in ast.walk(tree)]
    modules = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    modules |= {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}
    imported = {module.partition(".")[0] for module in modules} - {"surgical_marl", *sys.stdlib_module_names}
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [text for name, texts in project["optional-dependencies"].items() if name != "test" for text in texts]
    declared = {plain(re.split(r"[^\w.-]", text)[0]) for text in [*project["dependencies"], *extras]}
    distributions = importlib.metadata.packages_distributions()
    assert {"numpy", "yaml"} <= imported
    # what is not installed here goes by the name of its distribution
    missing = {name for name in imported if not declared & set(map(plain, distributions.get(name, [name])))}
    assert missing == {"lerobot"}, "who brings a policy of lerobot has it installed, with the torch that it wants"


def test_a_pettingzoo_without_ids_of_its_own_will_do() -> None:
    hide = "import sys\nfor part in ('', '.registration'):\n    sys.modules['pettingzoo.env_registry' + part] = None\n"
    found = run_python(hide + "import surgical_marl\nprint(surgical_marl.reach_v0.__name__)")
    assert found == "surgical_marl.reach_v0\n"


def plain(name: str) -> str:
    """The name of a distribution as registries compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


STARTED = """
import json, os
from surgical_marl.runtime import prepare_jax, prepare_mjx
prepare_jax()
prepare_mjx()
import jax
jax.numpy.ones(2).block_until_ready()
print(json.dumps({
    "flags": os.environ.get("XLA_FLAGS", ""),
    "cache": jax.config.jax_compilation_cache_dir,
    "threads": os.environ.get("PJRT_NPROC"),
    "precision": jax.config.jax_default_matmul_precision,
}))
"""


@pytest.mark.parametrize("first", ["", "import jax"])
def test_jax_is_prepared_before_it_starts(first: str, tmp_path: Path) -> None:
    # All that is printed is the JSON: importing mujoco.mjx must say nothing.
    got = json.loads(run_python(f"{first}\n{STARTED}", XDG_CACHE_HOME=str(tmp_path)))
    assert got["cache"] == str(tmp_path / "surgical-marl" / "xla")
    assert got["precision"] == "highest"
    # With as few threads as this machine may have cores, XLA can wait for itself for ever.
    assert int(got["threads"]) >= 8
    for flag in (runtime.FLAG, runtime.THREADS_FLAG):
        assert (f"{flag}=false" in got["flags"]) == runtime.knows_flag(flag)


@pytest.mark.skipif(not runtime.knows_flag(), reason="this jaxlib has no flag to come too late")
def test_a_late_preparation_on_a_cpu_warns() -> None:
    code = """
import warnings, jax
from surgical_marl.runtime import prepare_jax
jax.devices()
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    prepare_jax()
    prepare_jax()
print(*[w.message for w in caught if w.category is RuntimeWarning], sep="\\n")
"""
    (warning,) = run_python(code, JAX_PLATFORMS="cpu").splitlines()
    assert "prepare_jax()" in warning and runtime.FLAG in warning


def test_a_users_own_settings_of_jax_stay(tmp_path: Path) -> None:
    own = {
        "JAX_COMPILATION_CACHE_DIR": str(tmp_path),
        "JAX_DEFAULT_MATMUL_PRECISION": "float32",
        "PJRT_NPROC": "3",
    }
    flags = " ".join(f"{flag}=true" for flag in (runtime.FLAG, runtime.THREADS_FLAG) if runtime.knows_flag(flag))
    got = json.loads(run_python(STARTED, XLA_FLAGS=flags, **own))
    assert got.pop("flags") == flags
    assert got == {"cache": str(tmp_path), "precision": "float32", "threads": "3"}


@pytest.mark.parametrize(
    "version, known",
    [("0.6.2", False), ("0.7.0", True), ("0.10.2", True), ("0.11.2", False), ("1.0", False)],
)
def test_the_flag_is_only_for_versions_that_know_it(version: str, known: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.metadata.version", lambda _: version)
    assert runtime.knows_flag() == known


DEFERRED = """
from surgical_marl.runtime import defer_compiler
defer_compiler()
import sys, torch
from surgical_marl.learning.algorithms.mappo import MAPPO
optimizer = torch.optim.Adam([torch.nn.Parameter(torch.ones(2))])
optimizer.zero_grad()
optimizer.step()
print("sympy" in sys.modules)
print(torch.compile(lambda x: 2 * x, backend="eager")(torch.ones(1)).item(), "sympy" in sys.modules)
"""


def test_torchs_compiler_is_imported_when_it_is_used() -> None:
    assert run_python(DEFERRED).splitlines() == ["False", "2.0 True"]


@pytest.mark.parametrize("own, found", [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_the_command_lets_torchs_threads_sleep_unless_told_otherwise(
    own: str | None, found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    if own is not None:
        monkeypatch.setenv("OMP_WAIT_POLICY", own)
    said = run_python(
        "import os, sys\nfrom surgical_marl.cli.main import main\nmain(['list', 'tasks'])\n"
        "print(os.environ['OMP_WAIT_POLICY'], 'torch' in sys.modules)"
    )
    assert said.splitlines()[-1] == f"{found} False"  # torch reads it when it is imported


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere PyPI's torch has no CUDA libraries")
@pytest.mark.parametrize("has_gpu", [True, False])
def test_make_takes_torch_for_cpus_where_there_is_no_gpu(has_gpu: bool, tmp_path: Path) -> None:
    if not has_gpu and shutil.which("nvidia-smi"):
        pytest.skip("this machine has a GPU")
    if has_gpu:
        (tmp_path / "nvidia-smi").write_text("#!/bin/sh\n")
        (tmp_path / "nvidia-smi").chmod(0o755)
    env = {**os.environ, "PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    command = ["make", "--dry-run", "--always-make", ".venv/.ready"]
    said = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, check=True).stdout
    assert f'test -z "{"" if has_gpu else "yes"}" || .venv/bin/python -m pip install' in said
