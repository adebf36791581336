"""A thread that a needle draws through tissue: friction against what is set, stitches that hold, channels that empty.

One scene serves all tests, since its step is compiled once: the wound of `scenes/objects`, without weight, a pin of
12 mm with a thread at its tail, and a weight at the thread's other end. Pin and weight are led.
"""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.physics.contact.part_detection import NOWHERE
from surgical_marl.physics.systems.thread import _load
from surgical_marl.robots.rotation import turned
from tests.helpers.fused_kernels import run
from tests.helpers.needle_bench import bodies_at, no_ends
from tests.helpers.sewing_bench import DT, WEIGHT, Bench, Seen

FRICTION, LENGTH, NODES, PIN_LENGTH, THICK = 10.0, 0.105, 31, 0.012, 0.005
"""N/m of thread in tissue, of the thread, m, and its nodes, of the pin, m, and of the tissue, m."""
PIN = {
    "free": True, "density": 7900.0, "friction": {"sliding": 0.3, "torsion": 0.0}, "stiffness": 1e6,
    "shapes": [{"capsule": {"radius": 0.0003, "from": [0.0, 0.0, 0.0], "to": [0.0, 0.0, PIN_LENGTH]}}],
    "sites": {"tip": {"position": [0.0, 0.0, 0.0]}, "tail": {"position": [0.0, 0.0, PIN_LENGTH]}},
}  # fmt: skip
THREAD = {
    "kind": "thread", "length": LENGTH, "diameter": 0.00022, "material": "nylon", "nodes": NODES,
    "friction": {"sliding": 0.3, "torsion": 0.0},
}  # fmt: skip
LEFT, RIGHT = np.array([0.0231, 0.0093]), np.array([0.0231, 0.0207])
"""Where the pin goes down through one edge of the wound, and up through the other one, m.

The slit is at 14 to 16 mm."""


class Hands:
    """The pin and the weight, which go from place to place."""

    def __init__(self, bench: Bench) -> None:
        self.bench, self.physics = bench, bench.home
        self.pin, self.turn = np.array([*LEFT, THICK + 0.002]), 0.0
        self.weight = np.array([*LEFT, THICK + 0.002 + PIN_LENGTH + LENGTH])

    def copy(self) -> Hands:
        return copy.copy(self)

    def over(self, height: float) -> np.ndarray:
        """Return the place at this height over the weight, m, [3]."""
        return self.weight + np.array([0.0, 0.0, height])

    def lead(self, steps: int, pin: Any = None, weight: Any = None, turn: float | None = None, **rest: Any) -> Seen:
        """Lead the tip of the pin and the weight to places, m, and the pin to an angle about x, degrees."""
        share = np.linspace(0, 1, steps + 1)[:, None]
        ways = [here + share * (np.asarray(here if there is None else there) - here)
                for here, there in ((self.pin, pin), (self.weight, weight))]  # fmt: skip
        angles = self.turn + share[:, 0] * ((self.turn if turn is None else turn) - self.turn)
        axes = np.array([[turned((float(one), 0.0, 0.0)), np.eye(3)] for one in angles])
        self.pin, self.weight, self.turn = ways[0][-1], ways[1][-1], float(angles[-1])
        self.physics, seen = self.bench.lead(self.physics, np.stack(ways, 1), axes, **rest)
        return seen


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Bench:
    wound = yaml.safe_load((Path(sm.__file__).parent.parent / "scenes/objects/wound.yaml").read_text())
    wound["channels"] = {"puncture": 0.2, "cutting": 0.05, "thread_friction": FRICTION}
    objects = {
        "sheet": {"object": "sheet.yaml", "position": [0.0, 0.0, 0.0]},
        "pin": {"object": "pin.yaml", "position": [*LEFT.tolist(), THICK + 0.002]},
        "weight": {"object": "weight.yaml", "position": [*LEFT.tolist(), THICK + 0.002 + PIN_LENGTH + LENGTH]},
        "thread": {"object": "suture.yaml", "position": [*LEFT.tolist(), THICK + 0.002 + PIN_LENGTH],
                   "tilt": [0.0, -90.0, 0.0], "tied": {"first": "pin", "last": "weight"}},
    }  # fmt: skip
    files = {"sheet": wound, "pin": PIN, "weight": WEIGHT, "suture": THREAD}
    return Bench(tmp_path_factory.mktemp("sewing"), objects, files)


def friction(bench: Bench, physics: Any) -> float:
    """Return the friction of a thread that slides in all channels, N: that which is set times their lengths at rest."""
    state, total = physics.systems["sheet"].channels, 0.0
    for places, count in zip(np.asarray(state.places), np.asarray(state.total), strict=True):
        ways = np.diff(places[: int(count)], axis=0) * bench.tissue.grid.cell
        total += float(np.linalg.norm(ways, axis=1).sum())
    return FRICTION * total


def drop(seen: Seen) -> float:
    """Return by how much the tension at the pin is larger than that at the weight, N, at the end."""
    return float(seen.tension[-1, 0] - seen.tension[-1, -1])


@pytest.fixture(scope="module")
def threaded(bench: Bench) -> Hands:
    """The pin has gone down through the left edge, and its thread is in the channel."""
    hands = Hands(bench)
    hands.lead(200, pin=[*LEFT, -0.004], weight=hands.over(-0.010))
    hands.lead(100, pin=[*LEFT, -0.030], weight=hands.over(-0.025))
    return hands


@pytest.fixture(scope="module")
def stitched(threaded: Hands) -> Hands:
    """It has come up through the right edge too."""
    hands = threaded.copy()
    hands.lead(100, pin=[*RIGHT, -0.010], weight=hands.over(-0.012), turn=180.0)
    hands.lead(200, pin=[*RIGHT, 0.012], weight=hands.over(-0.005))
    hands.lead(100, pin=[*RIGHT, 0.027], weight=hands.over(-0.005))
    return hands


def channels(hands: Hands) -> Any:
    return hands.physics.systems["sheet"].channels


def test_places_pass_from_needle_to_thread(threaded: Hands) -> None:
    state = channels(threaded)
    assert state.needle.tolist() == [-1, -1, -1, -1] and state.thread.tolist() == [0, -1, -1, -1]
    along = np.asarray(state.along[0])[: int(state.total[0])]
    assert (along > 0.01).all() and (np.diff(along) < 0).all()  # from the entry to the exit, nearer to the needle
    np.testing.assert_allclose(-np.diff(along).sum(), friction(threaded.bench, threaded.physics) / FRICTION, rtol=0.05)


def test_friction_of_a_thread_is_that_of_the_length_inside(threaded: Hands) -> None:
    """In both directions, as long as it slides; and held still it stays where it is."""
    hands = threaded.copy()
    expected = friction(hands.bench, hands.physics)
    assert FRICTION * THICK < expected < 1.4 * FRICTION * THICK  # oblique: the edge bends as the pin goes in
    on = hands.lead(100, pin=[*LEFT, -0.045], weight=hands.over(-0.015))
    assert drop(on) == pytest.approx(expected, rel=0.02)
    still = hands.lead(100)
    assert np.ptp(still.thread[50:], 0).max() < 1e-6
    back = hands.lead(100, pin=[*LEFT, -0.029], weight=hands.over(0.016))
    assert drop(back) == pytest.approx(-expected, rel=0.02)


def test_its_tail_leaves_the_channel_empty(threaded: Hands) -> None:
    hands = threaded.copy()
    hands.lead(200, pin=[*LEFT, -0.114], weight=[*LEFT, 0.002])
    assert channels(hands).thread[0] == 0
    seen = hands.lead(100, pin=[*LEFT, -0.132], weight=[*LEFT, -0.016])
    state = channels(hands)
    assert state.thread.tolist() == [-1] * 4 and (np.asarray(state.along) == -1).all() and state.through[0]
    assert np.abs(seen.load[-1]).max() == 0 and np.ptp(seen.tension[-1]) < 1e-3
    assert np.abs(seen.nodes[-1] - hands.bench.tissue.rest).max() < 5e-4  # it relaxes


def test_a_needle_that_goes_back_takes_its_thread_out(threaded: Hands) -> None:
    """The pin is drawn back by its thread, tail first, and leaves at the entry."""
    hands = threaded.copy()
    hands.lead(200, pin=[*LEFT, -0.009], weight=hands.over(0.021))
    state = channels(hands)
    assert state.needle[0] == 0 and state.thread[0] == 0  # both are in it
    hands.lead(200, pin=[*LEFT, 0.012], weight=hands.over(0.021))
    state = channels(hands)
    assert state.needle[0] == -1 and state.thread[0] == -1 and (np.asarray(state.along) == -1).all()


def test_a_stitch_holds_both_edges_together(bench: Bench, stitched: Hands) -> None:
    """Against 1 N on each edge, around its bite. The ends are pulled over the other edges, as those of a knot are."""
    hands, rest = stitched.copy(), bench.tissue.rest
    reach = (LENGTH - 2 * THICK - (RIGHT - LEFT)[1]) / 2 + 0.008
    pin = [RIGHT[0] + 0.002, RIGHT[1] + PIN_LENGTH - reach, 0.007]
    weight = [LEFT[0] - 0.002, LEFT[1] + reach, 0.007]
    hands.lead(300, pin=pin, weight=weight, turn=90.0)
    sides = [(np.abs(rest[:, :2] - bite) < [0.0052, 0.0021]).all(1) for bite in (LEFT, RIGHT)]
    pull = np.zeros_like(rest)
    for way, side in zip((-1, 1), sides, strict=True):
        pull[side, 1] = way / side.sum()

    def wider(seen: Seen) -> float:
        moved = seen.nodes[-1, :, 1] - rest[:, 1]
        return float(moved[sides[1]].mean() - moved[sides[0]].mean())

    held, free = hands.lead(100, pull=pull), Hands(bench).lead(100, pull=pull)
    assert wider(free) > 0.001
    assert wider(held) < 0.0003
    assert channels(hands).thread.tolist() == [0, 0, -1, -1] and held.left_out.max() == 0


@pytest.mark.slow
def test_a_thread_runs_through_four_channels(stitched: Hands) -> None:
    """A running suture: down and up through both edges, twice. All of them hold it, by friction in each."""
    hands, aside = stitched.copy(), np.array([0.006, 0.0])
    hands.lead(100, pin=[*(RIGHT + aside), 0.007], turn=360.0)
    hands.lead(200, pin=[*(RIGHT + aside), -0.008], weight=hands.over(-0.008))
    hands.lead(100, pin=[*(RIGHT + aside), -0.020], weight=hands.over(-0.010))
    hands.lead(100, pin=[*(LEFT + aside), -0.010], weight=hands.over(-0.006), turn=540.0)
    hands.lead(200, pin=[*(LEFT + aside), 0.012], weight=hands.over(-0.006))
    seen = hands.lead(100, pin=[*(LEFT + aside), 0.045], weight=hands.over(-0.023))
    assert channels(hands).thread.tolist() == [0, 0, 0, 0] and channels(hands).through.all()
    assert seen.left_out.max() == 0
    assert drop(seen) > 0.95 * friction(hands.bench, hands.physics)  # and it rubs on the surface between them


def test_a_start_forgets_what_was_sewn(bench: Bench, threaded: Hands) -> None:
    fresh, used = bench.tissue.start(jnp.zeros((0, 3))).channels, channels(threaded)
    assert fresh.thread.tolist() == [-1] * 4 and (np.asarray(fresh.along) == -1).all()
    assert np.any(np.asarray(used.along) != np.asarray(fresh.along))
    first = Hands(bench).lead(100)
    np.testing.assert_array_equal(first.thread, Hands(bench).lead(100).thread)
    assert np.abs(first.load).max() == 0


@pytest.mark.slow
def test_a_kernel_holds_a_thread_as_jax_does(threaded: Hands, stitched: Hands) -> None:
    """Places on needle and thread, which parts are inside, and the forces on the nodes."""
    drawn = threaded.copy()
    drawn.lead(100, pin=[*LEFT, -0.008], weight=drawn.over(0.022))
    bench, hands = drawn.bench, [drawn, threaded, stitched]

    def step(thread: Any, tissue: Any, origin: Any, axes: Any, u: Any) -> Any:
        needles = bodies_at(origin, axes)._replace(strands=(bench.strand.strand(thread, "pin"),))
        now, _ = bench.tissue.follow(tissue, no_ends(bench.tissue), needles, DT)
        ends = bench.tissue.held(now, needles, 0, bench.step._couplings["thread"]._detection.nothing(NOWHERE), 0)
        return now.channels, bench.tissue.inside(now, needles, 0), ends.total, _load(ends, u, u).force

    states = [jax.tree.map(lambda *rows: np.stack(rows), *(one.physics.systems[name] for one in hands))
              for name in ("thread", "sheet")]  # fmt: skip
    origins = np.array([[one.pin] for one in hands], np.float32)
    axes = np.array([[turned((one.turn, 0.0, 0.0))] for one in hands], np.float32)
    u = 1e-4 * np.random.default_rng(0).standard_normal((3, NODES, 3)).astype(np.float32)
    columns = *states, origins, axes, u
    found, expected = run(step, *columns), jax.jit(jax.vmap(step))(*columns)
    (channels, inside, total, force), (wanted, *rest) = found, expected
    assert total.tolist() == rest[1].tolist() and total.min() >= 2 and inside.any(1).all()
    np.testing.assert_array_equal(inside, rest[0])
    np.testing.assert_allclose(force, rest[2], atol=2e-5 * np.abs(rest[2]).max())
    for name in ("along", "slip", "needle", "thread"):
        np.testing.assert_allclose(getattr(channels, name), getattr(wanted, name), atol=1e-6)
