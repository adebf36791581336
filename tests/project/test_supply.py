"""What an installation brings along: pinned, hashed, audited where a service answers, and released as it was tried."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import sys
from types import ModuleType
from typing import Any

import pytest

from tests.helpers import ROOT


def script(name: str) -> ModuleType:
    """A script of .ci as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / f".ci/{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_pinned_version_has_hashes() -> None:
    """If this fails, constraints.txt has changed: `make lock`."""
    plain = script("release").plain
    pins = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    hashed = (ROOT / "constraints.hashes.txt").read_text()
    blocks = re.findall(r"^([^\s;#]+).*\\\n(?:\s+--hash=sha256:[0-9a-f]{64}(?: \\)?\n)+", hashed, re.M)
    assert sorted(map(plain, blocks)) == sorted(map(plain, pins))
    assert "://" not in hashed, "hashes hold wherever a file comes from"


def answer(*packages: dict[str, Any]) -> str:
    return json.dumps({"dependencies": [{"name": "jax", "version": "0.10.2", **package} for package in packages]})


def test_an_audit_that_looked_at_nothing_says_so() -> None:
    """pip-audit itself ends with 0 and "no known vulnerabilities" where a mirror knows none of the packages."""
    judge = script("audit").judge
    unknown, good = {"skip_reason": "not found"}, {"vulns": []}
    weak = {"vulns": [{"id": "PYSEC-1", "fix_versions": ["0.10.3"]}]}
    for nothing in (None, "", "a page", answer(unknown, unknown)):
        code, said = judge(nothing)
        assert code == 0 and said.startswith("audit skipped: ") and "\n" not in said
    assert judge(answer(good, good)) == (0, "audit: 0 known weaknesses in 2 packages")
    assert judge(answer(good, unknown)) == (0, "audit: 0 known weaknesses in 1 packages\nnot known to the service: jax")
    code, said = judge(answer(good, weak))
    assert code == 1 and "jax 0.10.2: PYSEC-1, cured in ['0.10.3']" in said


def test_the_oldest_and_the_newest_versions_are_those_of_the_project() -> None:
    matrix = script("matrix")
    assert matrix.asked("gymnasium", "oldest") == "gymnasium==1.1"
    assert all(matrix.asked(name, "newest").startswith(f"{name}>=") for name in matrix.NAMES)


@pytest.mark.slow
def test_what_is_released_was_tried_in_a_new_environment() -> None:
    """It needs the tools of `pip install -e '.[test,supply]'`, and a registry of packages."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([sys.executable, ".ci/release.py"], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    bill = json.loads((ROOT / "dist/sbom.cdx.json").read_text())
    names = {part["name"] for part in bill["components"]}
    assert bill["metadata"]["component"]["name"] == "surgical-marl"
    assert {"jax", "mujoco", "torch"} <= names and not names & {"pytest", "mypy", "uv"}
    assert "file://" not in json.dumps(bill)
