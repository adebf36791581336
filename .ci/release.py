"""Build what is published, and try it as a user gets it: `make release`.

Writes into dist/: the wheel, the source archive, and sbom.cdx.json, a list of what the wheel brings along, in
CycloneDX's format. The wheel is installed into a new environment outside of the repository, every file of its
dependencies checked against constraints.hashes.txt. There it lists, trains and evaluates, and mypy reads its types from
a client's program.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
CLIENT = """
import surgical_marl as sm

env = sm.parallel_env("reach", scene="psm", num_envs=4)
names: list[str] = sm.list_scenes()
tip = sm.load_arm("psm").forward_kinematics
reveal_type(env)
reveal_type(names)
sm.parallel_env(1)
"""
"""What mypy is to find there: both types, and one error, in the last line."""


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, encoding="utf-8")
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout}{done.stderr}")
    return done.stdout


def plain(name: str) -> str:
    """Return the name of a package as registries compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def hashed(report: str) -> str:
    """Return the lines of constraints.hashes.txt for what pip reports that it would install."""
    wanted = {plain(item["metadata"]["name"]) for item in json.loads(report)["install"]} - {"surgical-marl"}
    blocks = re.split(
        r"\n(?=\S)", re.sub(r"(?m)^\s*#.*\n", "", (ROOT / "constraints.hashes.txt").read_text(encoding="utf-8"))
    )
    found = {plain(re.split("[= ;]", block)[0]): block for block in blocks}
    return "\n".join(found[name] for name in sorted(wanted)) + "\n"


def build(dist: Path) -> Path:
    """Build wheel and source archive into a folder, and return the wheel."""
    dist.mkdir(exist_ok=True)
    run(sys.executable, "-m", "hatchling", "build", "-d", dist, cwd=ROOT)
    (wheel,) = dist.glob("*.whl")
    return wheel


def install(wheel: Path, folder: Path) -> Path:
    """Install a wheel into a new environment, and return its Python."""
    run(sys.executable, "-m", "venv", folder / "environment", cwd=folder)
    python = folder / "environment/bin/python"
    pip = [python, "-m", "pip", "install", "-q", "--disable-pip-version-check"]
    constraints = ["-c", ROOT / "constraints.txt"]
    run(*pip, *constraints, "torch", cwd=folder)  # by itself: a build for CPUs has other hashes than PyPI's
    report, wanted = folder / "report.json", folder / "hashed.txt"
    run(*pip, *constraints, "--dry-run", "--report", report, wheel, cwd=folder)
    wanted.write_text(hashed(report.read_text(encoding="utf-8")), encoding="utf-8")
    run(*pip, "--require-hashes", "--no-deps", "-r", wanted, cwd=folder)
    # by its name, so that no path of this machine gets into the list
    run(*pip, "--no-deps", "--no-index", "--find-links", wheel.parent, "surgical-marl", cwd=folder)
    run(python, "-m", "pip", "check", cwd=folder)
    return python


def try_out(python: Path, folder: Path) -> None:
    """Do what a new user does, in a folder outside of the repository."""
    command = python.with_name("surgical-marl")
    where = run(python, "-c", "import surgical_marl; print(surgical_marl.__file__)", cwd=folder)
    assert Path(where.strip()).is_relative_to(folder), where
    assert "bimanual_psm" in run(command, "list", cwd=folder)
    small = ["num_envs=16", "iterations=2", "network.hidden=[16]"]
    run(command, "train", "reach", "--scene", "psm", "--device", "cpu", "--out", "run", *small, cwd=folder)
    for policy in ("run", "reach-psm"):
        found = json.loads(run(command, "eval", policy, "--episodes", "4", "--json", cwd=folder))
        assert found["episodes"] == 4 and found["task"] == "reach", found
    (folder / "client.py").write_text(CLIENT, encoding="utf-8")
    checker = [sys.executable, "-m", "mypy", "--python-executable", python, "--follow-imports", "silent", "client.py"]
    said = subprocess.run(checker, cwd=folder, capture_output=True, encoding="utf-8").stdout.splitlines()
    kinds = [re.split(r": (?=note|error)", line)[1][:60] for line in said[:-1]]
    assert len(kinds) == 3 and "Any" not in "".join(kinds[:2]) and "error" in kinds[2], "\n".join(said)


def main() -> int:
    dist = ROOT / "dist"
    wheel = build(dist)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name).resolve()
        python = install(wheel, folder)
        try_out(python, folder)
        bom = dist / "sbom.cdx.json"
        run(sys.executable, "-m", "cyclonedx_py", "environment", python, "--pyproject", ROOT / "pyproject.toml",
            "--output-reproducible", "-o", bom, cwd=folder)  # fmt: skip
    print(wheel, bom, f"{len(json.loads(bom.read_text(encoding='utf-8'))['components'])} packages", sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
