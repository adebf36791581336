"""Derivatives of the environment's step, by central finite differences: what optimises through the physics needs."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

import surgical_marl as sm
from surgical_marl.content import content_dir

STEPS, EPSILON = 20, 1e-3
SCENES = ["ecm", *(pytest.param(scene, marks=pytest.mark.slow) for scene in ("psm", "star", "bimanual_psm"))]
WHOLE_EPISODES = ("psm", "ecm", "star without friction", "bimanual_psm without friction")


class Episode:
    """The first steps of an episode, as a function of all actions as one array [STEPS, actions]."""

    def __init__(self, scene: str) -> None:
        self.env: Any = sm.jax_env("reach", scene=scene, observations="si")
        _, self.start = self.env.reset(jax.random.key(0))
        still, self._split = ravel_pytree({a: jnp.zeros(self.env.action_space(a).shape) for a in self.env.agents})
        self.size = len(still)
        self.jaws, _ = ravel_pytree({agent: self._jaw(agent) for agent in self.env.agents})

    def outcome(self, actions: Any) -> Any:
        """Everything that a step shows that has a derivative: observations and rewards of all agents, [STEPS, d]."""

        def step(state: Any, action: Any) -> Any:
            _, state, rewards, _, infos = self.env.step(None, state, self._split(action))
            seen = {agent: info["final_observation"] for agent, info in infos.items()}
            return state, ravel_pytree((seen, rewards))[0]

        return jax.lax.scan(step, self.start, actions)[1]

    def _jaw(self, agent: str) -> Any:
        """1 where a joint is the jaw, which only opens or closes: it has no derivative."""
        arm = self.env.env.scene.mounts[agent].arm
        return jnp.array([float(arm.jaw is not None and joint.name == arm.jaw.joint) for joint in arm.actuated])


def without_friction(scene: str, folder: Path) -> str:
    """Return the path of a copy of a scene in which no joint has Coulomb friction."""
    for name in {mount.arm.name for mount in sm.load_scene(scene).mounts.values()}:
        shutil.copytree(sm.load_arm(name).folder, folder / name)
        (urdf,) = (folder / name).glob("*.urdf")
        text, count = re.subn(r'friction="[^"]+"', 'friction="0"', urdf.read_text())
        assert count
        urdf.write_text(text)
    path = folder / "smooth.yaml"
    path.write_text((content_dir("scenes") / f"{scene}.yaml").read_text())
    return str(path)


@pytest.mark.slow
@pytest.mark.parametrize("scene", [*SCENES, "star without friction", "bimanual_psm without friction"])
def test_the_reverse_derivative_is_that_of_finite_differences(scene: str, tmp_path: Path) -> None:
    """From rest without a motion, and in motion; over the first step alone, and over 20 where motion has no corners.

    Joints of a STAR and of two PSMs stick and slip within 20 steps, and differences over such corners depend on their
    size. Without Coulomb friction there are no corners, and differences are those of the derivative.

    Many environments at once, so that both sides of the branch between touching and free arms are computed.
    """
    name, *smooth = scene.split(maxsplit=1)
    episode = Episode(without_friction(name, tmp_path) if smooth else name)
    rng = np.random.default_rng(0)
    direction = rng.uniform(-1, 1, (STEPS, episode.size)) * (1 - np.asarray(episode.jaws))
    resting, moving = np.zeros(direction.shape), rng.uniform(-0.7, 0.7, direction.shape)
    rows = [base + sign * EPSILON * direction for base in (resting, moving) for sign in (0, 1, -1)]
    actions = jnp.asarray(np.stack(rows), jnp.float32)
    weights = rng.normal(size=jax.eval_shape(episode.outcome, actions[0]).shape)
    first_alone = weights * (np.arange(STEPS) == 0)[:, None]

    def total(actions: Any, weights: Any) -> Any:
        return jnp.sum(weights * episode.outcome(actions))

    both = jax.jit(jax.vmap(jax.value_and_grad(total), (0, None)))
    for chosen in (weights, first_alone) if scene in WHOLE_EPISODES else (first_alone,):
        values, gradients = (np.asarray(x, float) for x in both(actions, jnp.asarray(chosen, jnp.float32)))
        assert np.isfinite(gradients).all()
        assert not gradients[..., np.asarray(episode.jaws) > 0].any()
        for k in (0, 3):
            expected = (values[k + 1] - values[k + 2]) / (2 * EPSILON)
            assert abs(expected) > 0.01
            assert np.sum(gradients[k] * direction) == pytest.approx(expected, rel=0.02, abs=1e-3)  # of float32


@pytest.mark.slow
def test_at_the_corners_of_a_motion_the_derivative_is_that_of_one_side() -> None:
    """Over 20 steps of two PSMs with friction, number by number: each is the quotient of one side, if not of both."""
    episode = Episode("bimanual_psm")
    rng = np.random.default_rng(0)
    direction = rng.uniform(-1, 1, (STEPS, episode.size)) * (1 - np.asarray(episode.jaws))
    base = rng.uniform(-0.7, 0.7, direction.shape)
    actions = jnp.asarray(np.stack([base + sign * EPSILON * direction for sign in (0, 1, -1)]), jnp.float32)
    along = jax.jit(jax.vmap(lambda at: jax.jvp(episode.outcome, (at,), (jnp.asarray(direction, jnp.float32),))))
    (here, after, before), (derivative, *_) = (np.asarray(x, float) for x in along(actions))
    sides = np.stack([after - here, here - before]) / EPSILON
    errors = np.abs(np.stack([*sides, sides.mean(0)]) - derivative)
    nearest, central = errors[:2].min(0), errors[2]
    allowed = 0.02 * np.abs(derivative) + 3e-3  # of float32
    print(f"{(central > allowed).sum()} of {central.size} at corners, where central differences are up to "
          f"{central.max():.2g} off; those of the nearer side {nearest.max():.1g}")  # fmt: skip
    assert (central > allowed).any()
    assert (nearest <= allowed).all()


@pytest.mark.slow
@pytest.mark.parametrize("scene", SCENES)
def test_forward_and_reverse_derivatives_are_finite_and_the_same(scene: str) -> None:
    """`jacfwd` and `jacrev` of the first step after a reset, without an action: `grad` and `jvp` are parts of them."""
    episode = Episode(scene)
    first = lambda action: episode.outcome(jnp.zeros((1, episode.size)) + action)[0]  # noqa: E731
    still = jnp.zeros(episode.size)
    forward, reverse = (np.asarray(jax.jit(of(first))(still)) for of in (jax.jacfwd, jax.jacrev))
    assert np.isfinite(forward).all() and np.abs(forward).max() > 0.01
    np.testing.assert_allclose(reverse, forward, atol=1e-5)
