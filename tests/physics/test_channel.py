"""Needles that go through tissue: forces against those that are set, work, and channels that stay."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.systems.channel_state import CUTS, PRESSES
from surgical_marl.physics.systems.system import Ends
from surgical_marl.physics.systems.tissue import TissueState
from surgical_marl.physics.systems.tissue_step import TissueStep
from surgical_marl.scenes.channel_file import ChannelFile
from tests.helpers.block_kernels import DEVICES, run_block
from tests.helpers.needle_bench import (
    ARC,
    DT,
    PIN,
    SIZE,
    Seen,
    away,
    bodies_at,
    joined,
    lead,
    no_ends,
    sheet,
    straight,
    turning,
)  # fmt: skip
from tests.physics.test_tissue_step import close, shaken, touched

SET = ChannelFile(puncture=0.2, cutting=0.05)
TISSUE = sheet((PIN, ARC), SET)
"""All tests share one piece of tissue, since its step is compiled once."""
PLACE = np.array([0.0131, 0.0117, 0.0])
CENTRE = (0.0165, 0.0083, 0.0055)
"""Of the arc: half a millimetre above the sheet, whose lower face is at 0."""
ENTERED = -1.9
"""Angle of the arc at which it has gone through, rad."""


def down(start: float, end: float, steps: int) -> np.ndarray:
    """Places of the pin's tip as it moves down, m, [steps + 1, 3]."""
    return PLACE + np.linspace(start, end, steps + 1)[:, None] * [0, 0, 1]


def below(height: float) -> np.ndarray:
    """A place on the pin's way, m, [3]."""
    return PLACE + np.array([0, 0, height])


def drive(way: np.ndarray, state: TissueState | None = None) -> tuple[TissueState, Seen]:
    """Lead the pin alone."""
    return lead(TISSUE, joined(straight(way), away(len(way))), state)


def curve(angles: np.ndarray, state: TissueState | None = None, **options: np.ndarray) -> tuple[TissueState, Seen]:
    """Lead the arc alone about its centre, which may move, m, [t, 3]."""
    pose = turning(CENTRE, angles)
    pose = pose._replace(origin=pose.origin + options.get("shift", np.zeros((len(angles), 3)))[:, None])
    return lead(TISSUE, joined(away(len(angles)), pose), state)


@pytest.fixture(scope="module")
def pierced() -> tuple[TissueState, Seen]:
    """The pin, as it has gone through: its tip is 4 mm below the sheet."""
    return drive(down(0.006, -0.004, 300))


@pytest.fixture(scope="module")
def sewn() -> tuple[TissueState, Seen]:
    """The arc, as it has gone through."""
    return curve(np.linspace(0.1, ENTERED, 501))


def test_a_tip_enters_at_the_threshold(pierced: tuple[TissueState, Seen], sewn: tuple[TissueState, Seen]) -> None:
    for n, (_, seen) in enumerate((pierced, sewn)):
        force, cuts = seen.pressed[:, n], seen.does[:, n] == CUTS
        assert force.max() == pytest.approx(SET.puncture, rel=0.05)
        assert np.flatnonzero(cuts)[0] > np.argmax(force)
        assert seen.does[0, n] == PRESSES  # a little above the sheet, where nothing is felt
        assert force[0] == 0


def test_a_channel_is_where_the_needle_went(pierced: tuple[TissueState, Seen]) -> None:
    view = pierced[1].channels
    assert view.there[-1].tolist() == [True, False, False, False] and view.through[-1, 0] and view.needle[-1, 0] == 0
    np.testing.assert_allclose(view.entry_at_rest[-1, 0], [*PLACE[:2], SIZE[2]], atol=3e-4)
    np.testing.assert_allclose(view.exit_at_rest[-1, 0], [*PLACE[:2], 0], atol=5e-4)
    assert view.depth[-1, 0] == pytest.approx(SIZE[2]) and view.swept[-1, 0] < 2e-4


def test_infos_have_the_largest_of_each_number_of_channels(sewn: tuple[TissueState, Seen]) -> None:
    view = TISSUE.view(sewn[0])
    depth, count = float(np.max(view.channels.depth)), int(np.sum(view.channels.there))
    assert depth > 1e-3 and count == 1
    told = {name: float(getattr(view, name)) for name in TISSUE.reports}
    assert told["bite_depth"] == depth and told["channel_count"] == count
    assert told["swept"] == np.max(view.channels.swept)
    assert told["tip_force"] == np.max(sewn[0].channels.tips.pressed)
    assert replace(TISSUE, needles=()).reports == ("tissue_force",)


def length(state: TissueState, channel: int = 0) -> float:
    """Length of a channel at rest, m."""
    assert state.channels
    places = np.asarray(state.channels.places[channel])[: int(state.channels.total[channel])] * TISSUE.grid.cell
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


def test_friction_is_that_of_the_length_inside(pierced: tuple[TissueState, Seen]) -> None:
    """In both directions."""
    state, _ = pierced
    expected = SET.friction * length(state)
    assert expected == pytest.approx(SET.friction * SIZE[2], rel=0.05)
    state, more = drive(down(-0.004, -0.008, 100), state)
    _, back = drive(down(-0.008, -0.004, 100), state)
    assert more.force[-1, 0, 2] == pytest.approx(expected, rel=0.02)
    assert back.force[-1, 0, 2] == pytest.approx(-expected, rel=0.02)


def test_a_curved_needle_has_the_friction_of_its_length_too(sewn: tuple[TissueState, Seen]) -> None:
    state, _ = sewn
    step = 2e-3
    _, more = curve(ENTERED - step * np.arange(101), state)
    along = more.work[-20:] / (step * 0.008)
    assert along.mean() == pytest.approx(SET.friction * length(state), rel=0.02)


def test_a_needle_sweeps_as_far_as_it_went_not_as_it_was_expected_to(pierced: tuple[TissueState, Seen]) -> None:
    """The pin is expected to go aside by 0.25 mm, as one that trembles is in each step."""
    channels, fast = TISSUE.channels, jnp.zeros((2, 6)).at[0, 0].set(0.1)
    assert channels

    @jax.jit
    def swept(state: TissueState, share: float) -> jax.Array:
        bodies = bodies_at(np.array([below(-0.004), [0.3, 0.3, 0.3]]), velocity=fast)
        state, ends = TISSUE.follow(state, no_ends(TISSUE), bodies, DT)
        assert state.channels
        after = channels.remember(
            state.channels, ends, lambda row, end: jnp.zeros(3), lambda row, end: share * end.shift
        )
        return after.swept[0]

    still, moved = (float(swept(pierced[0], share) - pierced[0].channels.swept[0]) for share in (0.0, 1.0))
    assert still == 0 and moved == pytest.approx(2.5e-4, rel=1e-3)


def test_off_its_arc_a_needle_costs_work_and_gives_none(sewn: tuple[TissueState, Seen]) -> None:
    """On a way that ends where it began, whatever the tissue gives back was put in before."""
    state, before = sewn
    assert before.channels.swept[-1, 0] < 1e-4
    way = 0.003 * np.concatenate([np.linspace(0, 1, 101), np.linspace(1, 0, 100)])
    for axis in np.eye(3)[[0, 1]]:
        _, seen = curve(np.full(201, ENTERED), state, shift=np.outer(way, axis))
        out, back = seen.work[:100].sum(), seen.work[100:].sum()
        assert out > 2e-4 and out + back > 0
        assert -back > 0.3 * out  # most of it was elastic
        assert 0.002 < seen.channels.swept[-1, 0] < 0.008
        lateral = np.abs(before.force[-1, 1, 1])
        assert np.abs(seen.force[99, 1] @ axis) > 4 * lateral


def test_turned_back_it_leaves_and_the_tissue_relaxes(sewn: tuple[TissueState, Seen]) -> None:
    state, seen = curve(np.linspace(ENTERED, 0.1, 501), sewn[0])
    assert state.channels and int(state.channels.needle[0]) == -1 and int(state.channels.total[0]) > 3
    assert np.abs(np.asarray(state.nodes.position) - TISSUE.rest).max() < 1e-6
    assert np.abs(seen.force[-1]).max() == 0
    again, seen = curve(np.linspace(0.1, ENTERED, 501), state)
    assert seen.pressed.max() < 0.2 * SET.puncture and not (seen.does == CUTS).any()  # no cutting in what is cut
    assert again.channels and int(again.channels.needle[0]) == 1 and int(again.channels.total[1]) == 0


def test_several_channels_at_once_and_room_for_four() -> None:
    """A pin goes in and is drawn out again at five places, then two needles go in."""
    state, steps = None, 200
    way = np.concatenate([np.linspace(0.0055, -0.005, steps // 2 + 1), np.linspace(-0.005, 0.03, steps // 2)])
    for number in range(5):
        place = np.array([0.006 + 0.004 * number, 0.01, 0.0])
        state, seen = lead(TISSUE, joined(straight(place + way[:, None] * [0, 0, 1]), away(steps + 1)), state)
        expected = [True] * min(number + 1, 4) + [False] * max(3 - number, 0)
        assert seen.channels.there[-1].tolist() == seen.channels.through[-1].tolist() == expected
        assert seen.channels.needle[-1].tolist() == [-1] * 4
    # the fifth has taken the place of one that nothing was in
    assert np.abs(seen.channels.entry_at_rest[-1, :, 0] - (0.006 + 0.004 * 4)).min() < 5e-4
    both = joined(straight(down(0.0055, -0.002, 200)), turning((0.024, 0.0083, 0.0055), np.linspace(0.1, -1.3, 201)))
    _, seen = lead(TISSUE, both)
    assert set(seen.channels.needle[-1].tolist()) == {-1, 0, 1}


def test_a_long_channel_keeps_every_other_place() -> None:
    """A pin that goes along the sheet, in its middle, for 25 mm."""
    turn = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])  # down becomes along x
    begin = np.array([-0.002, 0.0026, 0.0024])
    way = begin + np.linspace(0, 0.028, 601)[:, None] * [1, 0, 0]
    state, seen = lead(TISSUE, joined(straight(way, turn), away(601)))
    assert state.channels
    reached = seen.channels.exit_at_rest[-1, 0, 0] - seen.channels.entry_at_rest[-1, 0, 0]
    assert reached > 0.023 and int(state.channels.total[0]) <= 16
    # the tip cuts; the needle of 20 mm is inside with all of its length
    assert -seen.force[-1, 0, 0] == pytest.approx(SET.friction * 0.02 + SET.cutting, rel=0.03)


def test_other_contacts_of_a_needle_in_tissue_are_left_out(pierced: tuple[TissueState, Seen]) -> None:
    """They would push it out near its entry and its exit. Others stay, in their order."""
    state, _ = pierced
    assert TISSUE.channels and state.channels
    bodies = bodies_at(np.stack([below(-0.004), np.full(3, 0.3)]))
    touching = jnp.asarray(np.stack([below(0.005), below(0.012), below(0.001)]))
    rows = no_ends(TISSUE).rows
    rows = rows._replace(
        shape=rows.shape.at[:3].set(jnp.array([0, 0, 5])), place=rows.place.at[:3].set(touching),
        depth=rows.depth.at[:3].set(jnp.array([1e-4, 2e-4, 3e-4])),
    )  # fmt: skip
    ends = Ends(rows, jnp.int32(2), jnp.int32(3), jnp.int32(0))
    _, found = jax.jit(TISSUE.channels.follow, static_argnums=4)(
        state.channels, state.nodes.position, ends, bodies, DT
    )  # fmt: skip
    own = int(found.total) - 2
    assert (
        own >= 6 and int(found.moving) == own + 1 and (np.asarray(found.rows.part)[:own] >= TISSUE.channels.first).all()
    )
    np.testing.assert_allclose(found.rows.depth[own : own + 2], [2e-4, 3e-4])


def test_a_start_knows_nothing_of_what_was(pierced: tuple[TissueState, Seen]) -> None:
    fresh = jax.tree.leaves(TISSUE.start(jnp.zeros((0, 3))))
    changed = [np.any(np.asarray(a) != np.asarray(b)) for a, b in zip(fresh, jax.tree.leaves(pierced[0]), strict=True)]
    assert sum(changed) > 8
    again = drive(down(0.006, -0.004, 300))[1]
    np.testing.assert_array_equal(again.force, pierced[1].force)


@pytest.mark.parametrize("device", DEVICES)
def test_cuda_code_has_the_same_forces(device: str) -> None:
    """Of surface points, of what is in a channel, of tips that cut and of tips that press, mixed."""
    channels = TISSUE.channels
    assert channels
    step, nodes, (held, ends) = TissueStep(TISSUE.solver, None, DT, channels), shaken(TISSUE, 3e-4), touched(TISSUE, 7)
    kinds = np.array([0, channels.first, channels.pressing - 1, channels.pressing])
    rows = ends.rows._replace(part=jnp.asarray(kinds[np.arange(len(ends.rows.part)) % 4], jnp.int32))
    ends = ends._replace(rows=rows._replace(depth=jnp.where(rows.part == kinds[2], -1.0, rows.depth)))
    expected = jax.jit(step.respond)(nodes, held, ends)
    close(run_block(device, step.respond, nodes, held, ends), expected, 7, 2e-5)
