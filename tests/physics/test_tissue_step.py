"""The step of tissue with contacts: CUDA code against the functions of JAX, and what contacts do to it."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.physics.systems.brick_solve import Nodes
from surgical_marl.physics.systems.system import End, Ends
from surgical_marl.physics.systems.tissue import Tissue
from surgical_marl.physics.systems.tissue_step import Held, TissueStep
from tests.helpers.block_on_a_cpu import run_block
from tests.physics.test_tissue_contact import DT, strip

ROOM, CONTACTS = 12, 7
HOLES = (((True, True),) * 3, ((True, True), (False, False), (True, True)), ((True, True),) * 3)
SHEETS = {
    "sheet": strip(tears=1.5),
    "holes": strip(present=HOLES, size=(0.015, 0.012, 0.008), springs=(("front", 1e6),)),
}


def step_of(tissue: Tissue) -> TissueStep:
    return TissueStep(tissue.solver, tissue.tears, DT)


def shaken(tissue: Tissue, size: float) -> Nodes:
    """Nodes that are off their places by so much, m, and move."""
    rng, rest = np.random.default_rng(0), tissue.rest
    noise = tissue.solver.free[:, None] * rng.uniform(-1, 1, (2, *rest.shape))
    return Nodes(*(jnp.asarray(x, jnp.float32) for x in (rest + size * noise[0], 0.05 * noise[1])))


def touched(tissue: Tissue, contacts: int, q: int = 4) -> tuple[Held, Ends]:
    """Contacts that press, slide, stick and let go, and one that ties."""
    rng = np.random.default_rng(1)
    weights = rng.uniform(0, 1, (ROOM, q)) * (rng.uniform(size=(ROOM, q)) < 0.7) + np.eye(1, q)
    nodes = rng.choice(np.flatnonzero(tissue.grid.mass), (ROOM, q))
    held = Held(jnp.asarray(nodes, jnp.int32), jnp.asarray(weights / weights.sum(1, keepdims=True), jnp.float32))
    normal = rng.normal(size=(ROOM, 3))

    def real(low: float, high: float, *more: int) -> Any:
        return jnp.asarray(rng.uniform(low, high, (ROOM, *more)), jnp.float32)

    whole = jnp.zeros(ROOM, jnp.int32)
    rows = End(
        whole, real(0, 1), whole, real(-1e-4, 3e-4), real(0, 0, 3),
        jnp.asarray(normal / np.linalg.norm(normal, axis=1, keepdims=True), jnp.float32), real(1e3, 1e4),
        real(0.01, 1), jnp.arange(ROOM) == 2, real(-1e-4, 1e-4, 3), real(-1e-4, 1e-4, 3),
    )  # fmt: skip
    return held, Ends(rows, jnp.int32(max(contacts - 2, 0)), jnp.int32(contacts), jnp.int32(0))


def close(found: dict[str, np.ndarray], expected: Any, share: float) -> None:
    for name, values in expected._asdict().items():
        scale = np.abs(values).max(initial=1e-12)
        np.testing.assert_allclose(found[name], values, atol=share * scale, err_msg=name)


@pytest.mark.parametrize(("sheet", "contacts", "q"), [("sheet", CONTACTS, 4), ("sheet", 0, 4), ("holes", CONTACTS, 8)])
def test_cuda_code_computes_what_jax_does(sheet: str, contacts: int, q: int) -> None:
    tissue = SHEETS[sheet]
    step, nodes, (held, ends) = step_of(tissue), shaken(tissue, 4e-4), touched(tissue, contacts, q)
    expected = jax.jit(step.respond)(nodes, held, ends)
    assert contacts == 0 or (np.abs(expected.force[:contacts]).max(1) > 0).sum() >= 4
    close(run_block(step.respond, nodes, held, ends), expected, 2e-5)
    pushed = jnp.asarray(
        np.random.default_rng(2).normal(size=(ROOM, 3)) * (np.arange(ROOM) < contacts)[:, None], jnp.float32
    )
    args = nodes, held, ends, expected, pushed
    close(run_block(step.move, *args), jax.jit(step.move)(*args), 2e-6)
