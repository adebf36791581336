"""Grasps, handovers and releases against C MuJoCo at a tenth of the step, with an elliptic cone that does not creep."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

import mujoco
import numpy as np
import pytest

from docs.studies import plain_mujoco
from docs.studies.grasping import angle
from docs.studies.shaking import CHUNK, CLOSING, OBJECTS, Grasps, Seen

SPEED = 0.5
"""Share of full speed at which arms move: at full speed steps of 2.5 ms alone put an arm 0.3 mm elsewhere."""
NEAR = 3e-4
"""Most by which an object may be elsewhere, m."""
NEEDLES = 60
"""Needles that two arms hold."""


def played(grasps: Grasps, begin: Any, chunks: list[np.ndarray], held: np.ndarray) -> tuple[Any, Seen]:
    """Return states after chunks of actions [a, n], and what was seen."""
    actions = np.concatenate([np.broadcast_to(chunk, (len(held), CHUNK, *chunk.shape)) for chunk in chunks], 1)
    return grasps.play(begin, actions, held)


@pytest.mark.slow
def test_a_grasped_object_is_lifted_swung_and_let_go_as_in_plain_mujoco() -> None:
    """From a closed grasp, by the same commands, until the fingers press with half of their force as the jaw opens."""
    grasps, held = Grasps(list(OBJECTS)), np.array([0, 0, 1, 1, 2, 2] * 2)
    begin, _ = grasps.play(grasps.begin(held, seed=5), grasps.still(len(held)), held)
    ways = ([0, 0, -1], [1, 0, -1], [0, 1, 0], [-1, -1, 0])
    chunks = [np.array([[*(SPEED * np.array(way)), 0, 0, 0, -1]], np.float32) for way in ways]
    _, seen = played(grasps, begin, [*chunks, np.array([[0, 0, 0, 0, 0, 0, 1]], np.float32)], held)
    off = np.linalg.norm(plain_mujoco.play(grasps, begin, seen.command, held) - seen.place, axis=-1)
    force = seen.force.min((2, 3))
    grips = force > force[:, 4 * CHUNK - 1, None] / 2
    assert grips[:, : 4 * CHUNK].all() and grips[:, 4 * CHUNK :].any() and (force[:, -1] == 0).all()
    assert off[grips].max() < NEAR


@pytest.mark.slow
def test_a_needle_lies_in_a_closed_jaw_nearly_as_in_plain_mujoco() -> None:
    """From an open jaw around it. Springs of friction give way as they take the load, and a thin wire rolls on them.

    Of 120 needles half were within 2.7 degrees and 0.12 mm, and nine of ten within 5.0 degrees and 0.24 mm. Where
    friction took a part of what had rolled for a slide it was 3.1 and 5.9 degrees, and up to 42 instead of 13.
    """
    grasps, held = Grasps(["needle_sh"]), np.zeros(120, int)
    begin = grasps.begin(held, seed=6)
    _, seen = grasps.play(begin, grasps.still(len(held)), held)
    position, rotation = (x[:, -1, 0] for x in plain_mujoco.play_in_jaws(grasps, begin, seen.command, held))
    turn = np.degrees(angle(seen.rotation[:, -1, 0], rotation))
    off = np.linalg.norm(seen.position[:, -1, 0] - position, axis=-1)
    assert np.median(turn) < 3.0 and np.quantile(turn, 0.9) < 5.5 and turn.max() < 25, np.sort(turn)
    assert np.median(off) < 1.3e-4 and np.quantile(off, 0.9) < 2.8e-4, np.sort(off)


@pytest.mark.slow
def test_plain_mujoco_says_where_an_object_is_in_both_jaws_that_hold_it() -> None:
    """By which `studies.grasping --mujoco` tells whether it was dropped or slipped."""
    grasps, begin, held = two_arms_hold(4)
    _, seen = played(grasps, begin, [np.array([[0, 0, 0, 0, 0, 0, -1]] * 2, np.float32)], held)
    position, rotation = plain_mujoco.play_in_jaws(grasps, begin, seen.command, held)
    np.testing.assert_allclose(position, seen.position, atol=NEAR)
    np.testing.assert_allclose(rotation, seen.rotation, atol=0.02)


def two_arms_hold(count: int) -> tuple[Grasps, Any, np.ndarray]:
    """Return arms in pairs, their states once each pair has closed its jaws on a needle, and the needles' numbers."""
    grasps, held = Grasps(["needle_sh"], arms=2), np.zeros(count, int)
    begin, _ = grasps.play(grasps.begin(held, seed=5), grasps.still(count, CLOSING), held)
    return grasps, begin, held


def converged(grasps: Grasps, begin: Any, command: np.ndarray, held: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return of which objects C MuJoCo with half its step says the same as this path, to half of `NEAR`, [E]."""
    with patch.object(plain_mujoco, "FINE", 2 * plain_mujoco.FINE):
        off = np.linalg.norm(plain_mujoco.play(grasps, begin, command, held) - path, axis=-1)
    found: np.ndarray = off.max(1) < NEAR / 2
    return found


@pytest.mark.slow
def test_an_object_is_handed_over_as_in_plain_mujoco() -> None:
    """Two arms hold a needle; the first opens its jaw and draws back, and the second carries the needle away.

    As a jaw opens, what it held may slip in the other one, and the open finger may strike the needle as it leaves. Few
    needles do, but how far those go hangs by so little that C MuJoCo with half its step is 1.6 mm away from itself for
    one of 120, while nine of ten are within 0.08 mm. So the farthest needle says nothing about the solver, and half and
    nine tenths of them are bounded here. In two series of 120 needles half were within 0.14 mm after the first jaw had
    opened, and nine of ten within 0.42 mm.

    While both arms hold it a needle stays within 0.13 mm, in four series of 60, but for one of the 240: jaws have
    rocked its arc and left it on its way, C MuJoCo moves it by 0.3 mm at once, and with half its step elsewhere.

    With one Newton step instead of `STEPS` nine of ten are within 0.66 mm after the first jaw has opened, and within
    1.3 mm in the end; two steps are enough. Friction hardly matters, since a needle weighs next to nothing: the next
    test sees that.
    """
    grasps, begin, held = two_arms_hold(NEEDLES)
    still, back, away = (np.array([*way, 0, 0, 0]) for way in ((0, 0, 0), (0, 0, -SPEED), (SPEED, 0, -SPEED)))
    moves = ((still, still, -1), (still, still, 1), (back, still, 1), (back, still, 1), (still, away, 1))
    chunks = [np.array([[*first, jaw], [*second, -1]], np.float32) for first, second, jaw in moves]
    _, seen = played(grasps, begin, chunks, held)
    theirs = plain_mujoco.play(grasps, begin, seen.command, held)
    off = np.linalg.norm(theirs - seen.place, axis=-1)
    within = lambda steps, share: np.quantile(off[:, :steps].max(1), share)  # noqa: E731
    assert seen.holding[:, CHUNK - 1].all() and (seen.holding[:, -1] == [False, True]).all(1).mean() > 0.95
    sure = converged(grasps, begin, seen.command[:, :CHUNK], held, theirs[:, :CHUNK])
    assert sure.mean() > 0.95 and off[sure, :CHUNK].max() < NEAR / 2, "while both hold it"
    assert within(CHUNK, 0.5) < NEAR / 4, "while both hold it"
    assert within(4 * CHUNK, 0.5) < 2.5e-4 and within(4 * CHUNK, 0.9) < 6e-4, "when one has let go"
    assert within(5 * CHUNK, 0.5) < NEAR and within(5 * CHUNK, 0.9) < 8e-4, "when the other one has carried it away"


@pytest.mark.slow
def test_a_needle_slides_in_jaws_that_pull_at_it_as_far_as_in_plain_mujoco() -> None:
    """Two arms hold a needle, and one draws back until the needle slides in a jaw.

    Which jaw it slides in, and when, differs from needle to needle. How much farther apart the jaws are in the end does
    not: the rest of the way is what the arms give way under friction. In four series of 60 needles half of them slid
    1.04, 1.06, 1.02 and 1.02 times as far as in C MuJoCo, or less. With 20 % less friction in ours it was 1.31 times in
    the first series, and with 20 % more 0.86 times. All of a series together hang by few that slide by millimetres:
    1.04, 1.05, 0.99 and 1.14 times, with other friction 1.64 and 0.54 times. Where a patch bore the sum of what its
    points bear as they slide and as they turn in place, half slid 0.95 times as far, and all together 0.78 times.
    """
    grasps, begin, held = two_arms_hold(NEEDLES)
    way = np.array([[0, 0, 0, 0, 0, 0, -1], [0.4 * SPEED, 0, -0.4 * SPEED, 0, 0, 0, -1]], np.float32)
    _, seen = played(grasps, begin, [way], held)

    def between(data: mujoco.MjData, _: str) -> Any:
        first, second = (np.mean([data.body(name).xpos for name in jaw], 0) for jaw in grasps.fingers)
        return np.linalg.norm(first - second)

    of_needle = np.einsum("etaji,etaj->etai", seen.rotation, seen.position)  # from a jaw to the needle, in its axes
    ours = np.linalg.norm(of_needle[:, :, 0] - of_needle[:, :, 1], axis=-1)
    theirs = plain_mujoco.play(grasps, begin, seen.command, held, between)
    slid, should = (far[:, -1] - far[:, 0] for far in (ours, theirs))
    assert should.mean() > NEAR and 0.85 < slid.mean() / should.mean() < 1.15, (slid, should)
    assert 0.96 < np.median(slid / should) < 1.15, (slid, should)
