"""What `list -v` says, and the share of a workspace that arms have in common."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surgical_marl import list_arms, list_scenes, load_scene
from surgical_marl.cli.describe import shared_workspace
from surgical_marl.cli.main import main


def test_list_v_names_all_and_says_what_they_are(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "500")
    assert main(["list", "-v"]) == 0
    out = capsys.readouterr().out
    for name in (*list_scenes(), *list_arms(), "psm_0", "ecm_0", "reach"):
        assert f"{name} " in out
    clearance, pairs = load_scene("bimanual_psm"), len(load_scene("bimanual_psm").pairs)
    home = {agent: mount.arm.home for agent, mount in clearance.mounts.items()}
    assert f"{pairs} pairs of shapes can touch, {1000 * float(clearance.clearance(home)):.0f} mm apart at home" in out
    assert "% of an arm's workspace shared" in out


def test_the_shared_workspace_is_all_none_or_between(tmp_path: Path) -> None:
    def shared(x: float) -> float:
        path = tmp_path / f"at{x}.yaml"
        path.write_text(f"arms:\n  psm_0: {{arm: psm}}\n  psm_1: {{arm: psm, position: [{x}, 0, 0]}}\n")
        return shared_workspace(load_scene(path))

    assert shared(0.0) > 0.99
    assert shared(5.0) == 0.0
    assert shared(0.0) > shared(0.1) > shared(0.3) > 0.0
    assert np.isnan(shared_workspace(load_scene("psm")))


@pytest.mark.parametrize("name", [name for name in list_scenes() if len(load_scene(name).agents) > 1])
def test_arms_of_a_scene_share_a_workspace(name: str) -> None:
    assert shared_workspace(load_scene(name)) > 0.5
