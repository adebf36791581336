"""A thread that touches: friction as Coulomb says, on a board, around a cylinder, between pads; nothing creeps."""

from __future__ import annotations

import itertools
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from surgical_marl.physics.contact.shapes import Segments, between_segments
from tests.helpers.thread_bench import DT, Bench, Told, axis_plate, suture


def line(nodes: int, length: float, height: float = 0.0) -> np.ndarray:
    return np.stack([np.linspace(0.0, length, nodes), np.zeros(nodes), np.full(nodes, height)], 1)


def test_a_board_holds_back_what_is_dragged_over_it() -> None:
    """By mu times its weight; the end that pulls hangs in the air."""
    n, mu, speed = 20, 0.5, 0.01
    thread = suture(line(n, 0.05, 0.11e-3), drag=0.0)
    bench = Bench(thread, plates=[axis_plate([0, 0, -1e-4], [1, 1], 1e-4)], mu=mu)  # float32 knows thin plates best
    end = thread.path[-1]

    def told(k: Any) -> Told:
        return Told(ties=[(n - 2, 1.0, jnp.array(end) + speed * DT * (k + 1) * jnp.array([1.0, 0, 0]))])

    _, seen = bench.run(bench.start(), 400, told)
    weight = thread.rod.mass.sum() * 9.81
    late = slice(200, None)
    borne, pull = np.asarray(seen.normal)[late], np.asarray(seen.tied)[late, 0, 0]
    np.testing.assert_allclose(-np.asarray(seen.friction)[late, 0], mu * borne, rtol=1e-3)
    np.testing.assert_allclose(borne.mean(), weight, rtol=1e-2)  # the end that is led bears some
    np.testing.assert_allclose(pull.mean(), mu * borne.mean(), rtol=1e-3)


def test_a_cylinder_holds_back_as_a_capstan_does() -> None:
    n, radius, mu, low = 48, 0.008, 0.3, 0.1
    edge = 1.3e-3
    r = radius + 0.11e-3
    turn = 2 * np.arctan(edge / 2 / r)  # edges touch the cylinder with their middles
    lead = (n - 1 - int(np.pi / turn)) // 2
    angles = np.clip(np.arange(n - 1) - lead, 0, int(np.pi / turn)) * turn  # of each edge
    steps = edge * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1)
    path = np.concatenate([[[-r, 0, -edge * (lead + 0.5)]], steps]).cumsum(0)
    thread = suture(path, bending=0.01)
    bench = Bench(thread, rods=[([0, -0.02, 0], [0, 0.02, 0], radius)], mu=mu)
    pull = np.zeros((n, 3), np.float32)
    pull[0, 2] = -low

    def told(k: Any) -> Told:
        way = 0.004 * DT * jnp.maximum(k - 200, 0)
        return Told(ties=[(n - 2, 1.0, jnp.array(path[-1]) - jnp.array([0.0, 0, 1.0]) * way)],
                    pull=pull * jnp.minimum((k + 1) / 200, 1.0))  # fmt: skip

    _, seen = bench.run(bench.start(), 700, told)
    tension, edges = np.asarray(seen.tension)[400:], np.diff(np.asarray(seen.position)[400:], axis=1)
    ratio = tension[:, n - 2] / tension[:, 0]
    slopes = np.unwrap(np.arctan2(edges[..., 2], edges[..., 0]))
    angle = slopes[:, 0] - slopes[:, -1]
    assert angle.min() > 3.0
    np.testing.assert_allclose(ratio.mean(), np.exp(mu * angle.mean()), rtol=1e-2)


@pytest.fixture(scope="module")
def pinched() -> tuple[Bench, float]:
    """Return a thread between two pads of 10 mm, and the pull at which Coulomb lets it slip."""
    n, mu, overlap = 16, 0.8, 5e-6
    thread = suture(line(n, 0.032) - [0.016, 0, 0])
    apart = 0.0006 + 0.11e-3 - overlap
    bench = Bench(thread, plates=[axis_plate([0, 0, sign * apart], [0.0044, 0.002], 0.0006) for sign in (-1, 1)], mu=mu)
    return bench, mu


def pull_on(bench: Bench, size: Any) -> Array:
    pull = jnp.zeros((bench.thread.nodes, 3)).at[-1, 0].set(1.0)
    return pull * size


def test_pads_let_slip_at_mu_times_what_they_press_with(pinched: tuple[Bench, float]) -> None:
    """And not before: until then the springs of friction give way by less than 0.1 um a step."""
    bench, mu = pinched
    settled, seen = bench.run(bench.start(), 50, lambda k: Told())
    press, steps = float(seen.normal[-1]), 800
    np.testing.assert_allclose(press, 2 * 1e4 * 5e-6 * 0.0088 / bench.thread.rod.length, rtol=1e-2)
    _, seen = bench.run(settled, steps, lambda k: Told(pull=pull_on(bench, 1.1 * mu * press * (k + 1) / steps)))
    place = np.asarray(seen.position)[:, 6:10, 0].mean(1)
    slides = np.diff(place, prepend=place[0]) > 3e-7
    assert slides.any()
    np.testing.assert_allclose(1.1 * (slides.argmax() + 1) / steps, 1.0, atol=1e-2)


def test_pads_hold_for_ten_seconds_without_creep(pinched: tuple[Bench, float]) -> None:
    bench, mu = pinched
    settled, seen = bench.run(bench.start(), 50, lambda k: Told())
    press = float(seen.normal[-1])
    held, _ = bench.run(
        settled, 200, lambda k: Told(pull=pull_on(bench, 0.9 * mu * press * jnp.minimum((k + 1) / 100, 1)))
    )
    later, _ = bench.run(held, 4000, lambda k: Told(pull=pull_on(bench, 0.9 * mu * press)))
    drift = np.abs(np.asarray(later.chain.position - held.chain.position)).max()
    assert drift < 1e-6


def test_a_loop_around_a_peg_holds_what_hangs_from_it() -> None:
    """A bight over a peg, one end tied, the other one pulled with less than friction needs to slip: it stays."""
    n, radius, mu, low = 30, 0.002, 0.5, 0.05
    edge, lead = 1e-3, 11
    turn = 2 * np.arctan(edge / 2 / (radius + 0.11e-3))
    angles = np.clip(np.arange(n - 1) - lead, 0, int(np.pi / turn)) * turn
    steps = edge * np.stack([np.sin(angles), 0 * angles, np.cos(angles)], 1)
    path = np.concatenate([[[-radius - 0.11e-3, 0, -edge * (lead + 0.5)]], steps]).cumsum(0)
    bench = Bench(suture(path, bending=0.01), rods=[([0, -0.02, 0], [0, 0.02, 0], radius)], mu=mu)
    ends = np.zeros((n, 3), np.float32)
    ends[0, 2], ends[-1, 2] = -low, -2.5 * low  # exp(0.5 * 3.0) is 4.5

    def told(k: Any) -> Told:
        return Told(pull=ends * jnp.minimum((k + 1) / 100, 1.0))

    held, _ = bench.run(bench.start(), 400, told)
    later, seen = bench.run(held, 400, told, first=400)
    assert np.abs(np.asarray(later.chain.position - held.chain.position)).max() < 1e-6
    np.testing.assert_allclose(np.asarray(seen.tension)[-1, [0, -2]], [low, 2.5 * low], rtol=1e-3)


def test_it_tears_where_it_is_pulled_harder_than_it_is_strong() -> None:
    n, strength = 8, 2.0
    thread = suture(line(n, 0.02), strength=strength)
    bench = Bench(thread)

    def told(k: Any) -> Told:
        ties = [(0, 0.0, jnp.zeros(3)), (n - 2, 1.0, jnp.array(thread.path[-1]) + jnp.array([1e-5, 0.0, 0.0]) * k)]
        return Told(ties=ties)

    final, seen = bench.run(bench.start(), 120, told)
    pulls, broken = np.asarray(seen.tension), np.flatnonzero(np.asarray(final.holds)[:-1] == 0)
    torn = int((pulls.max(1) > strength).argmax())
    assert pulls[torn - 1].max() <= strength < pulls[torn].max() < 1.1 * strength
    assert not thread.view(bench.start()).broken and thread.view(final).broken
    assert np.isfinite(pulls).all() and np.abs(pulls[-1]).max() < 1e-2
    assert np.linalg.norm(np.diff(np.asarray(final.chain.position), axis=0), axis=-1)[broken].min() > thread.rod.length


def laid(corners: list[list[float]], edge: float) -> np.ndarray:
    """Return nodes one edge apart along a line through some corners."""
    way = [np.linspace(a, b, 300, endpoint=False) for a, b in itertools.pairwise(np.array(corners))]
    nodes = [np.array(corners[0])]
    for place in np.concatenate(way):
        if (gap := np.linalg.norm(place - nodes[-1])) >= edge:
            nodes.append(nodes[-1] + (place - nodes[-1]) * edge / gap)
    return np.array(nodes)


def test_a_crossing_that_is_pulled_tight_does_not_pass_through() -> None:
    """One strand is tied at both ends, and a later one of the same thread is led down across it by 3 mm."""
    turn = [[8 + 6 * np.sin(a), -6 + 6 * np.cos(a), 0.6 * a / np.pi] for a in np.linspace(0, 1.5 * np.pi, 20)]
    path = laid([[1e-3 * x for x in corner] for corner in ([-8, 0, 0], *turn, [0.5, -6, 0.6], [0.5, 8, 0.6])], 2e-3)
    thread, n = suture(path, bending=0.1), len(path)
    one = int(np.linalg.norm(path - [8e-3, 0, 0], axis=1).argmin())
    other = int(np.linalg.norm(path - [5e-4, -5e-3, 6e-4], axis=1).argmin())

    def told(k: Any) -> Told:
        down = jnp.array([0.0, 0.0, -25e-6]) * jnp.clip(k - 20.0, 0.0, 120.0)
        fixed = [(0, 0.0, path[0]), (one, 0.0, path[one])]
        return Told(ties=[*fixed, (other, 0.0, path[other] + down), (n - 2, 1.0, path[-1] + down)])

    bench = Bench(thread)
    final, seen = bench.run(bench.start(), 200, told)
    parts, place = np.asarray(final.rubbed.key)[0], np.asarray(final.chain.position)
    assert final.rubbed.total >= 1
    under, over = int(parts // n), int(parts % n)  # the numbers of the two parts that touch
    assert under < one and over >= other
    point = between_segments(*(Segments(place[k], place[k + 1], 1.1e-4) for k in (over, under)))
    assert 0 < point.depth < 1e-4 and point.normal[2] > 0.5
    pulls = np.asarray(seen.tension)
    assert pulls[-1].max() > 0.3 and np.abs(pulls[-1] - pulls[-20]).max() < 1e-3
