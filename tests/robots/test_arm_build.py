"""The URDFs that ship are those that `python arms/build` writes, and every arm among them loads."""

from __future__ import annotations

import runpy

import numpy as np
import pytest

from surgical_marl import list_arms, load_arm
from surgical_marl.robots.spec import build_spec
from tests.helpers import ROOT

ARMS = ROOT / "arms"


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    """What the generator writes, run as `python arms/build` runs it, but without writing."""
    return runpy.run_path(str(ARMS / "build"), run_name="build")["texts"]()


def test_files_are_what_the_generator_writes(texts: dict[str, str]) -> None:
    assert sorted(texts) == list_arms()
    for name, text in texts.items():
        # Bytes, not text: a file with other line ends or another encoding is another file.
        assert (ARMS / name / f"{name}.urdf").read_bytes() == text.encode(), f"run `python arms/build`: {name} differs"


@pytest.mark.parametrize("name", list_arms())
def test_arm_loads_with_its_home_inside_the_limits(name: str) -> None:
    arm = load_arm(name)
    assert arm.urdf.name == name
    assert arm.description and (arm.folder / "README.md").is_file()
    assert np.all((arm.lower <= arm.home) & (arm.home <= arm.upper))
    # A target may not outrun the joint that follows it.
    assert all(0 < joint.drive.speed <= joint.velocity for joint in arm.joints)
    assert build_spec(arm).compile().nu == len(arm.joints) + len(arm.cables)
