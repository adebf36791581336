"""The changes of physics under which the oracles with tissue are measured again."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import numpy as np
import pytest

from docs.studies import sensitivity
from docs.studies.command import run
from docs.studies.sensitivity import CHANGES, OFF, main, make_env
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.scene import Scene


@pytest.fixture(scope="module")
def shipped() -> Scene:
    return load_scene("psm_suture")


def test_steps_are_half_as_long_and_the_shipped_model_stays(shipped: Scene) -> None:
    before = shipped.model.opt.timestep
    assert CHANGES["half steps"](shipped).model.opt.timestep == before / 2
    assert shipped.model.opt.timestep == before == CHANGES["as shipped"](shipped).model.opt.timestep


def test_two_layers_are_of_the_same_tissue(shipped: Scene) -> None:
    one: Any = shipped.systems["wound"]
    two: Any = CHANGES["two layers"](shipped).systems["wound"]
    assert two.grid.counts.tolist() == np.add(one.grid.counts, [0, 0, 1]).tolist()
    assert two.grid.cell[2] == one.grid.cell[2] / 2 and two.rest.max(0).tolist() == one.rest.max(0).tolist()
    np.testing.assert_array_equal(np.array(two.present)[..., 1], np.array(one.present)[..., 0])


def test_moduli_and_friction_are_drawn(shipped: Scene) -> None:
    drawn = CHANGES["E and friction"](shipped)
    assert {drawn.systems[name].ranges for name in ("wound", "thread")} == {(OFF, OFF)}
    assert drawn.randomisation.object_friction == OFF and not shipped.randomisation


def test_an_environment_has_the_change_and_as_long_control_steps() -> None:
    made: list[Any] = []
    with patch.object(sensitivity, "BatchedEnv", lambda *args, **options: made.append((args, options))):
        for change in CHANGES:
            make_env("needle_drive", change, 4)
    assert [options["decimation"] for _, options in made] == [8, 16, 8, 8]


def test_the_table_has_a_row_for_a_task(capsys: pytest.CaptureFixture[str]) -> None:
    found = {"success_rate": 0.875, "max_tissue_force_n": 1.0, "intervals": {"success_rate": [0.76, 0.95]}}
    with patch.object(sensitivity, "measure", lambda *_: found):
        assert main(["--task", "suture", "--only", "half steps", "--starts", "32"]) == 0
    assert capsys.readouterr().out.splitlines() == ["| | half steps |", "|---|---|", "| `suture` | 88 (76 to 95) |"]


def test_a_bad_number_of_starts_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        run("sensitivity", lambda: main(["--starts", "1"]))
    assert ended.value.code == 2 and "--starts" in capsys.readouterr().err
