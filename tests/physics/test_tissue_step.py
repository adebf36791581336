"""The step of tissue with contacts: CUDA code against the functions of JAX, and what contacts do to it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from surgical_marl.engines.fused import kernel
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.physics.solver.cholesky import LOWER
from surgical_marl.physics.systems.brick_solve import Nodes
from surgical_marl.physics.systems.system import End, Ends, Springs
from surgical_marl.physics.systems.tissue import Tissue
from surgical_marl.physics.systems.tissue_step import Held, TissueStep
from tests.helpers.block_kernels import DEVICES, cuda_of, run_block
from tests.physics.test_tissue_contact import DT, scene_file, strip

ROOM, CONTACTS = 12, 7
HOLES = (((True, True),) * 3, ((True, True), (False, False), (True, True)), ((True, True),) * 3)
SHEETS = {
    "sheet": strip(tears=1.5),
    "holes": strip(present=HOLES, size=(0.015, 0.012, 0.008), springs=(("front", 1e6),)),
    "loose": strip(fixed=(), springs=(("left", 1e4),), present=(((True, True),) * 2,) * 3),
}


@cache
def step_of(sheet: str) -> tuple[TissueStep, Callable[..., Any], Callable[..., Any]]:
    """The step of a sheet, and its functions as JAX compiles them."""
    step = TissueStep(SHEETS[sheet].solver, SHEETS[sheet].tears, DT)
    return step, jax.jit(step.respond), jax.jit(step.move)


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


def borne(tissue: Tissue, springs: int) -> tuple[Springs, ...]:
    """Loads of two systems, of which the first has so many springs, and the second one less."""
    if not springs:
        return ()
    rng, loads = np.random.default_rng(5), []
    for used in (springs, springs - 1):
        nodes, room = rng.choice(np.flatnonzero(tissue.grid.mass), (springs, 4)), (springs, 3)
        factor = rng.normal(size=(springs, 3, 3))
        weights, stiff = rng.dirichlet(np.ones(4), springs), 300 * np.einsum("cij,ckj->cik", factor, factor)
        parts = weights, 0.05 * rng.normal(size=room), stiff[:, *LOWER]
        real = (jnp.asarray(part, jnp.float32) for part in parts)
        loads.append(Springs(jnp.asarray(nodes, jnp.int32), *real, jnp.int32(used)))
    return tuple(loads)


def close(found: dict[str, np.ndarray], expected: Any, contacts: int, share: float) -> None:
    for name, values in expected._asdict().items():
        own, scale = found[name], np.abs(values).max(initial=1e-12)
        if values.shape[:1] == (ROOM,):
            own, values = own[:contacts], values[:contacts]
        np.testing.assert_allclose(own, values, atol=share * scale, err_msg=name)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("sheet", "contacts", "q", "springs"),
    [("sheet", CONTACTS, 4, 0), ("sheet", 0, 4, 0), ("holes", CONTACTS, 8, 6), ("loose", CONTACTS, 4, 3)],
)
def test_cuda_code_computes_what_jax_does(sheet: str, contacts: int, q: int, springs: int, device: str) -> None:
    tissue = SHEETS[sheet]
    (step, respond, move), nodes, (held, ends) = step_of(sheet), shaken(tissue, 4e-4), touched(tissue, contacts, q)
    loads = borne(tissue, springs)
    expected = respond(nodes, held, ends, loads)
    assert contacts == 0 or (np.abs(expected.force[:contacts]).max(1) > 0).sum() >= 4
    close(run_block(device, step.respond, nodes, held, ends, loads), expected, contacts, 5e-5)
    pushed = jnp.asarray(
        np.random.default_rng(2).normal(size=(ROOM, 3)) * (np.arange(ROOM) < contacts)[:, None], jnp.float32
    )
    args = nodes, held, ends, expected, pushed
    close(run_block(device, step.move, *args), move(*args), contacts, 4e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_nodes_of_a_brick_that_would_be_crushed_go_less_far(device: str) -> None:
    """Two nodes are pushed through the sheet; those that share no brick with them go as far as they would.

    A brick near the other end is flat already, and is not made flatter.
    """
    tissue, (step, _, move) = SHEETS["sheet"], step_of("sheet")
    nodes, (held, ends) = shaken(tissue, 1e-4), touched(tissue, 0)
    rng, rest, pushed = np.random.default_rng(3), tissue.rest, jnp.zeros((ROOM, 3))
    shift = 1e-4 * rng.normal(size=rest.shape) * tissue.solver.free[:, None]
    upper = rest[:, 2] > 0.004
    struck = upper & (rest[:, 0] > 0.004) & (rest[:, 0] < 0.006) & (rest[:, 1] == 0)
    flat = upper & (rest[:, 0] > 0.024)
    far = (rest[:, 0] > 0.011) & (rest[:, 0] < 0.019)
    assert struck.any() and far.any()
    place = np.array(nodes.position)
    place[flat, 2] = place[np.flatnonzero(flat) - 1, 2] + 2e-5
    nodes = nodes._replace(position=jnp.asarray(place))
    shift[struck] += [0, 0, -0.02]
    shift[flat] += [0, 0, -2e-5]
    answer: Any = jax.tree.map(lambda x: jnp.zeros(x.shape), jax.eval_shape(step.respond, nodes, held, ends))
    args = nodes, held, ends, answer._replace(shift=jnp.asarray(shift, jnp.float32)), pushed
    moved = move(*args)
    before, after = (volumes(tissue, x) for x in (nodes.position, moved.position))
    thin = before < 0.01
    assert thin.any() and (after[thin] > 0.999 * before[thin]).all()
    assert (after[~thin] > 0.399 * before[~thin]).all() and (after < 0.6 * before).any()
    np.testing.assert_allclose((moved.position - nodes.position)[far], shift[far], atol=1e-8)
    close(run_block(device, step.move, *args), moved, 0, 2e-6)


def volumes(tissue: Tissue, position: Any) -> np.ndarray:
    """Volumes of the bricks in their middles, as shares of those at rest, [e]."""
    corners = np.asarray(position)[tissue.grid.first[:, None] + tissue.grid.offsets].reshape(-1, 2, 2, 2, 3)
    sides = [np.diff(corners, axis=axis).mean((1, 2, 3)) for axis in (1, 2, 3)]
    return np.linalg.det(np.stack(sides, 1)) / np.prod(tissue.grid.cell)


@pytest.mark.skipif(not kernel.has_cuda(), reason="needs a CUDA device")
def test_a_gpu_pushes_it_as_a_cpu_does(tmp_path: Path) -> None:
    found = []
    devices: Any = (("mjx", "cpu"), ("fused", "cuda"))
    for engine, device in devices:
        env = BatchedEnv("reach", scene_file(tmp_path), num_envs=2, engine=engine, device=device)
        env.reset(seed=0)
        action = np.zeros((2, len(env.scene.mounts["psm_0"].arm.actuated)), np.float32)
        action[0, 2] = 1.0  # into the tissue
        for _ in range(10):
            step = env.step({"psm_0": action})
        force = np.array(step.infos["psm_0"]["tissue_force"])
        found.append([env.engine.read(f".physics.{name}", "numpy") for name in ("sheet.nodes.position", "arms.qpos")])
        found[-1].append(force)
        env.close()
    assert found[0][2][0] > 0.05
    for one, other, atol in zip(*found, (1e-5, 1e-5, 5e-3), strict=True):
        np.testing.assert_allclose(one, other, atol=atol)


def test_nvrtc_compiles_the_kernels(tmp_path: Path) -> None:
    """Without a GPU; shared memory and barriers are there, and no thread has arrays in slow memory."""
    tissue, step = SHEETS["sheet"], step_of("sheet")[0]
    nodes, (held, ends) = shaken(tissue, 1e-4), touched(tissue, 1)
    answer: Any = jax.tree.map(lambda x: jnp.zeros(x.shape), jax.eval_shape(step.respond, nodes, held, ends))
    pushed = jnp.zeros((ROOM, 3))
    for name, function, args in (("respond", step.respond, ()), ("move", step.move, (answer, pushed))):
        body, threads = cuda_of(function, nodes, held, ends, *args)
        module = kernel.wp.get_module(f"surgical_marl_test_{name}")
        module.options.update(enable_backward=False, block_dim=threads)
        kernel._make(name, body, module, threads=threads)
        (ptx,) = kernel.wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
        text = ptx.read_text()
        assert ".shared" in text and "bar.sync" in text and ".local" not in text, name
