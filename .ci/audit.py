"""Known weaknesses and licences of what an install brings: `make audit`.

pip-audit asks a service for each version in constraints.txt. Where none answers, or it knows none of the packages, as
behind some mirrors of PyPI, the audit is skipped, and says so: nothing was found wrong, and nothing was looked at.
pip-licenses reads what is installed; pyproject.toml holds what is allowed.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
SECONDS = 60
"""After which a service counts as one that does not answer."""


def judge(answer: str | None) -> tuple[int, str]:
    """Return an exit code and what to say of pip-audit's JSON, None if there was no answer."""
    try:
        packages: list[dict[str, Any]] = json.loads(answer or "")["dependencies"]
    except (ValueError, KeyError):
        return 0, "audit skipped: no service of known weaknesses answers here"
    skipped = [package["name"] for package in packages if "skip_reason" in package]
    weak = [
        f"{package['name']} {package['version']}: {weakness['id']}, cured in {weakness['fix_versions'] or 'no version'}"
        for package in packages
        for weakness in package.get("vulns", [])
    ]
    if len(skipped) == len(packages):
        return 0, f"audit skipped: the service that answers here knows none of the {len(packages)} packages"
    said = f"audit: {len(weak)} known weaknesses in {len(packages) - len(skipped)} packages"
    unknown = [f"not known to the service: {', '.join(skipped)}"] if skipped else []
    return int(bool(weak)), "\n".join([said, *weak, *unknown])


def audit(arguments: list[str]) -> str | None:
    command = [sys.executable, "-m", "pip_audit", "--disable-pip", "--no-deps", "--progress-spinner", "off",
               "--timeout", "5", "--format", "json", "-r", str(ROOT / "constraints.txt"), *arguments]  # fmt: skip
    try:
        return subprocess.run(command, capture_output=True, encoding="utf-8", timeout=SECONDS).stdout
    except subprocess.TimeoutExpired:
        return None


def licences() -> tuple[int, str]:
    command = [Path(sys.executable).with_name("pip-licenses")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, encoding="utf-8")
    count = len(done.stdout.splitlines()) - 1
    return done.returncode, done.stderr.strip() if done.returncode else f"licences: {count} packages, all as allowed"


def main(arguments: list[str]) -> int:
    results = [judge(audit(arguments)), licences()]
    for _, text in results:
        print(text)
    return max(code for code, _ in results)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
