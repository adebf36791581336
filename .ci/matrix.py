"""Install the package into fresh environments of other versions, and run tests there: `make matrix`.

One environment for each Python from 3.11 to 3.13 that is found on PATH, with the oldest jax, torch, pettingzoo and
gymnasium that pyproject.toml allows, and with the newest. Prints a table for docs/reliability.md.

On Linux PyPI's torch brings gigabytes of CUDA libraries. Where pip would install those, the environment is made without
torch: then an environment alone is tried, with the numbers that a seed leads to. `--cuda-builds` installs them, for one
environment at a time: they run on a CPU, too.

    python .ci/matrix.py [--python 3.13] [--versions oldest] [--cuda-builds] [--keep FOLDER]
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[1]
PYTHONS = ("3.11", "3.12", "3.13")
NAMES = ("jax", "torch", "pettingzoo", "gymnasium")
WITHOUT_TORCH = ("tests/project/test_public_surface.py::test_a_seed_leads_to_the_numbers_that_it_led_to",)
WITH_TORCH = (
    "tests/project/test_public_surface.py",
    "tests/project/test_determinism.py",
    "tests/learning/test_learning.py",
)


def allowed() -> dict[str, str]:
    """Return what pyproject.toml asks of each of the four, such as ">=0.6,<0.13"."""
    wanted = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["dependencies"]
    found = {re.split(r"[^\w-]", text)[0]: text for text in wanted}
    return {name: found[name].removeprefix(name) for name in NAMES}


def asked(name: str, versions: str) -> str:
    """Return a requirement for the newest or the oldest release of a package."""
    bounds = allowed()[name]
    oldest = re.search(r">=([\d.]+)", bounds)
    assert oldest
    return f"{name}{bounds}" if versions == "newest" else f"{name}=={oldest[1]}"


def run(*command: str | Path, **environment: str) -> subprocess.CompletedProcess[str]:
    own = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    return subprocess.run([*map(str, command)], env={**own, **environment}, capture_output=True, encoding="utf-8")


def torch_for_cpus(python: Path, wanted: str) -> str | None:
    """Return the release of torch that pip would install without CUDA libraries, None if there is none.

    Of the newest releases, that is the one of constraints.txt where pip knows no other build for CPUs.
    """
    pin = re.search(r"^torch==.*$", (ROOT / "constraints.txt").read_text(encoding="utf-8"), re.M)
    assert pin
    for requirement in (wanted, pin[0]) if ">=" in wanted else (wanted,):
        with tempfile.NamedTemporaryFile(suffix=".json") as file:
            done = run(python, "-m", "pip", "install", "-q", "--dry-run", "--report", file.name, requirement)
            items = json.loads(Path(file.name).read_text(encoding="utf-8"))["install"] if done.returncode == 0 else []
        found = {item["metadata"]["name"].lower(): item["metadata"]["version"] for item in items}
        if "torch" in found and not [name for name in found if name.startswith(("nvidia", "cuda", "triton"))]:
            return found["torch"]
    return None


def try_one(python: str, versions: str, folder: Path, cuda_builds: bool) -> tuple[dict[str, str], str]:
    """Make an environment and run its tests; return what was installed and what came of it."""
    uv, own = Path(sys.executable).with_name("uv"), folder / "bin/python"
    run(python, "-m", "venv", folder)
    wanted, override, with_torch = {name: asked(name, versions) for name in NAMES}, folder / "override.txt", cuda_builds
    override.write_text("", encoding="utf-8")
    if not cuda_builds:
        run(own, "-m", "pip", "install", "-q", "-U", "pip")
        if torch := torch_for_cpus(own, wanted.pop("torch")):
            with_torch = True
            run(own, "-m", "pip", "install", "-q", f"torch=={torch}")
        # torch is there already, or not to be had: uv leaves it alone
        override.write_text("torch; python_version < '3'\ntorchvision; python_version < '3'\n", encoding="utf-8")
    packages = [ROOT, "pytest>=9", "hatchling", *wanted.values()]
    done = run(uv, "pip", "install", "-q", "--python", own, "--override", override, *packages)
    if done.returncode:
        return {}, "does not resolve: " + " ".join(done.stderr.split())[:300]
    listed = json.loads(run(uv, "pip", "list", "--python", own, "--format", "json").stdout)
    found = {item["name"]: item["version"] for item in listed if item["name"] in NAMES}
    tests = [f"{ROOT}/{name}" for name in (WITH_TORCH if with_torch else WITHOUT_TORCH)]
    done = run(own, "-m", "pytest", "-q", "-p", "no:cacheprovider", *tests, XDG_CACHE_HOME=str(folder / "cache"))
    (folder / "pytest.log").write_text(done.stdout + done.stderr, encoding="utf-8")
    return found, re.sub(r" in [\d.]+s.*| \(.*|=", "", done.stdout.strip().splitlines()[-1]).strip()


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--python", action="append", choices=PYTHONS)
    parser.add_argument("--versions", action="append", choices=("oldest", "newest"))
    parser.add_argument("--cuda-builds", action="store_true", help="take torch with CUDA libraries, some gigabytes")
    parser.add_argument("--keep", type=Path, help="folder for the environments and the output of their tests")
    arguments = parser.parse_args()
    print("| Python | versions |", *(f"{name} |" for name in NAMES), "result |", flush=True)
    print("|---|---|" + "---|" * (len(NAMES) + 1), flush=True)
    failed = False
    for version in arguments.python or PYTHONS:
        python = shutil.which(f"python{version}")
        here = run(python, "--version").stdout.split() if python else []
        for versions in arguments.versions or ("oldest", "newest"):
            if not python or not here:
                print(f"| {version} | {versions} |" + " |" * len(NAMES) + " not found on this machine |", flush=True)
                continue
            with tempfile.TemporaryDirectory() as folder:
                kept = arguments.keep / f"{version}-{versions}" if arguments.keep else Path(folder) / "environment"
                found, result = try_one(python, versions, kept.resolve(), arguments.cuda_builds)
            failed |= "failed" in result or "error" in result or "does not" in result
            shown = [found.get(name, "without") for name in NAMES]
            print(f"| {here[-1]} | {versions} |", *(f"{text} |" for text in shown), f"{result} |", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
