"""Stages of a step: a step that is split at them computes what the whole step does, with both engines."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import yaml
from jax.extend import core

import surgical_marl as sm
from surgical_marl.bench.physics import PhysicsAlone, bare_state
from surgical_marl.engines.compilation import unsaid
from surgical_marl.engines.fused import engine as fused_engine
from surgical_marl.engines.fused import kernel
from surgical_marl.engines.fused.compiler import make_source, trace_environment
from surgical_marl.engines.fused.kernel_layout import BUFFERS, Leaf, Source, all_stages
from surgical_marl.engines.fused.stage_code import block_code
from surgical_marl.engines.fused.symbolic_array import Unsupported
from surgical_marl.engines.mjx import MjxEngine
from surgical_marl.engines.split import Loop, Part, Stage, Unsplittable, split
from surgical_marl.engines.stages import Call, block_stage, host_stage
from surgical_marl.envs.env import Env
from surgical_marl.envs.state import Carry
from surgical_marl.physics.systems.system import Response
from surgical_marl.plugins.systems import SYSTEMS
from tests.helpers.fused_kernels import gpu_code
from tests.helpers.membrane import MIDDLE, RELAX, Membrane, Nodes, press, relax

TABLE = np.arange(9, dtype=np.float32).reshape(3, 3) / 9


def turned(state: Any, tip: Any, table: Any) -> Any:
    return {"x": table @ state["x"] + tip, "force": state["x"].sum()}


turn = block_stage(turned, "...", threads=64)
look = host_stage("pictures", lambda moved: {"seen": 0.5 * moved["x"].sum() + moved["tip"].sum()})


# -- steps of a vector x, a random key and a factor w


def without(x: Any, key: Any, w: Any) -> Any:
    return jnp.sin(x) * w, key


def in_a_row(x: Any, key: Any, w: Any) -> Any:
    found = turn({"x": x}, jnp.cos(x), TABLE)
    more = turn({"x": found["x"]}, x, TABLE)
    return more["x"] * w + found["force"], x


def in_functions(x: Any, key: Any, w: Any) -> Any:
    inner = jax.checkpoint(jax.jit(lambda x: turn({"x": x}, w * x, TABLE)["x"]))
    return inner(inner(x)) + inner(jnp.ones(3))


def in_a_loop(x: Any, key: Any, w: Any) -> Any:
    given, zero, key = jnp.exp(x), jnp.zeros(3), jax.random.wrap_key_data(key)

    def one(carry: Any, _: None) -> Any:
        x, count, first = carry
        tip = jnp.cos(x) * given + zero + jax.random.normal(jax.random.fold_in(key, 1), (3,))
        found = turn({"x": x}, tip, TABLE)
        return (found["x"] + 0.1 * found["force"] * tip, count + 1, first), None

    (x, count, first), _ = jax.lax.scan(one, (x, 0, given), None, length=3)
    return x + w * jax.random.normal(key, (3,)), count, first


def in_two_loops(x: Any, key: Any, w: Any) -> Any:
    def inner(x: Any, _: None) -> Any:
        return turn({"x": x}, w * x, TABLE)["x"] / 3, None

    def outer(carry: Any, _: None) -> Any:
        before, x = carry
        return (x, jax.lax.scan(inner, x + before, None, length=2)[0]), None

    return jax.lax.scan(outer, (x, jnp.cos(x)), None, length=3)[0]


def on_the_host(x: Any, key: Any, w: Any) -> Any:
    found = turn({"x": x}, jnp.cos(x), TABLE)
    return look({"x": found["x"], "tip": jnp.ones(2)})["seen"] * w + x, found["force"]


STEPS = [without, in_a_row, in_functions, in_a_loop, in_two_loops, on_the_host]
GIVEN = jnp.array([0.1, -0.4, 0.3]), np.array([0, 7], np.uint32), jnp.float32(2)


def run(parts: list[Part], values: dict[Any, Any]) -> None:
    for part in parts:
        if isinstance(part, Loop):
            for _ in range(part.length):
                run(part.parts, values)
            continue
        stage = isinstance(part, Stage)
        function = core.jaxpr_as_fun(part.call.reference if stage else part.jaxpr)
        read = [values[one] if isinstance(one, core.Var) else one for one in part.reads]
        values.update(zip(part.writes, function(*read), strict=True))


@pytest.mark.parametrize("step", STEPS, ids=lambda step: step.__name__)
@pytest.mark.parametrize("where", [lambda call: True, lambda call: call.cuda is None], ids=["all", "host"])
def test_parts_compute_what_the_step_does(step: Callable[..., Any], where: Callable[[Call], bool]) -> None:
    traced = jax.make_jaxpr(step)(*GIVEN)
    arguments, parts = split(traced, where)
    values = dict(zip(arguments, GIVEN, strict=True))
    run(parts, values)
    expected = jax.tree.leaves(step(*GIVEN))
    for number, value in enumerate(expected):
        np.testing.assert_allclose(values[number], value, rtol=2e-6)
    assert len(parts) == 1 or step is not without


def test_a_stage_gets_what_it_needs_and_all_else_comes_later() -> None:
    def step(x: Any) -> Any:
        early, late = jnp.sin(x), jnp.tan(x)
        return turn({"x": early}, x, TABLE)["x"] + late + jnp.arange(3.0)

    _, (first, stage, last) = split(jax.make_jaxpr(step)(GIVEN[0]), lambda call: True)
    names = [[one.primitive.name for one in part.equations] for part in (first, last)]  # type: ignore[union-attr]
    assert names[0] == ["sin"] and "tan" in names[1] and "iota" in names[1]
    assert stage.call.reads == ("state.x", "tip", "table") and stage.call.writes == ("force", "x")  # type: ignore[union-attr]
    np.testing.assert_array_equal(stage.reads[2], TABLE)  # type: ignore[union-attr]


def in_a_branch(x: Any) -> Any:
    return jax.lax.cond(x[0] > 0, lambda x: turn({"x": x}, x, TABLE)["x"], lambda x: x, x)


def in_a_while(x: Any) -> Any:
    return jax.lax.while_loop(lambda x: x[0] > 0, lambda x: turn({"x": x}, x, TABLE)["x"], x)


def over_rows(x: Any) -> Any:
    return jax.lax.scan(lambda x, row: (turn({"x": x}, row, TABLE)["x"], None), x, jnp.ones((2, 3)))[0]


@pytest.mark.parametrize(
    ("step", "place"), [(in_a_branch, "`cond`"), (in_a_while, "`while`"), (over_rows, "a scan over rows")]
)
def test_a_place_where_no_step_can_be_split_is_named(step: Callable[..., Any], place: str) -> None:
    with pytest.raises(Unsplittable, match=f"stage 'turned' inside of {place}; it can be in a step, or in a scan"):
        split(jax.make_jaxpr(step)(GIVEN[0]), lambda call: True)


@pytest.mark.parametrize("threads", [0, 33, 2048])
def test_a_bad_number_of_threads_is_refused(threads: int) -> None:
    with pytest.raises(ValueError, match=f"a multiple of 32 from 32 to 1024, not {threads}"):
        block_stage(turned, "", threads)


def test_all_that_a_stage_uses_is_given() -> None:
    def step(x: Any) -> Any:
        return block_stage(lambda y: x + y, "", 32, name="sum")(2 * x)

    with pytest.raises(ValueError, match="stage 'sum' uses a traced array that is not an argument"):
        jax.jit(step)(GIVEN[0])


def test_jax_takes_a_stage_for_its_reference() -> None:
    x, many = GIVEN[0], jnp.stack([GIVEN[0], -GIVEN[0]])
    whole, staged = (partial(lambda f, x: f({"x": x}, jnp.cos(x), TABLE)["x"].sum(), f) for f in (turned, turn))
    for change in (jax.jit, jax.grad, jax.jacfwd, lambda f: jax.grad(jax.checkpoint(f))):
        np.testing.assert_allclose(change(staged)(x), change(whole)(x), rtol=1e-6)
    np.testing.assert_allclose(jax.jit(jax.vmap(staged))(many), jax.vmap(whole)(many), rtol=1e-6)


class Stepper:
    """A step of numbers."""

    def __init__(self, step: Callable[[Any], Any]) -> None:
        self._step = step

    agents, decimation, title, content, parameters, pauses = (), 1, "branches", b"branches", {}, False
    classes = ()

    def reset(self, key: Any, episode: Any, parameters: Any) -> Any:
        return bare_state(Carry(jnp.zeros(120), (), key, episode, jnp.int32(0)), jnp.zeros(1))  # type: ignore[arg-type]

    def step(self, carry: Any, actions: Any, parameters: Any) -> Any:
        return bare_state(carry._replace(physics=self._step(carry.physics)), jnp.zeros(1))

    def source(self) -> Source:
        """Return the source of its kernels on a GPU."""
        return make_source(trace_environment(self, unsaid), {}, False, unsaid)  # type: ignore[arg-type]


def between_branches(x: Any) -> Any:
    def busy(x: Any) -> Any:
        return jax.lax.cond(x[0] > 0, lambda x: jnp.sin(x) * x + 1.0, lambda x: x, x)

    x = busy(x)
    return busy(busy(x.at[:3].set(turn({"x": x[:3]}, x[3:6], TABLE)["x"])))


def test_the_part_with_most_branches_says_how_much_there_was_to_do() -> None:
    """Environments are sorted by it: a later kernel must not write over it."""
    found = Stepper(between_branches).source()
    assert [name for name, text in found.bodies.items() if "STI(work" in text] == ["step_1"]
    assert "WORK(" in found.bodies["step_0"]


def test_each_call_of_a_stage_has_its_own_fields() -> None:
    def step(x: Any) -> Any:
        return jax.lax.fori_loop(0, 2, lambda _, x: x.at[:3].set(in_a_row(x[:3], None, x[0])[0]), x)

    loop = next(stage for stage in Stepper(step).source().stages if stage.kind == "loop")
    first, second = (stage for stage in loop.stages if stage.kind == "block")
    assert (first.name, second.name) == ("turned", "turned_1") and first.code != second.code
    assert first.writes["x"] == second.reads["state.x"]


def test_numbers_that_change_places_are_not_copied_one_after_the_other() -> None:
    """A kernel reads all of them first."""

    def step(x: Any) -> Any:
        def swap(found: Any, _: None) -> Any:
            one, other = found
            return (other, one.at[:3].set(turn({"x": one[:3]}, other[:3], TABLE)["x"])), None

        return jnp.concatenate(jax.lax.scan(swap, (x, jnp.sin(x)), None, length=2)[0])[:120]

    loop = next(stage for stage in Stepper(step).source().stages if stage.kind == "loop")
    assert not [stage for stage in loop.stages if stage.kind == "copy"]


def test_the_host_is_asked_once_in_a_step() -> None:
    with pytest.raises(Unsupported, match="a second call of stage 'pictures' of the host"):
        Stepper(lambda x: x + look({"x": x, "tip": look({"x": x, "tip": x})["seen"]})["seen"]).source()


# -- a system with stages

BESIDE, PUSH = 0.014, 0.15
ENVS, STEP, TIMES = 2, 8, 18


@pytest.fixture(autouse=True)
def registered() -> Iterator[None]:
    sm.register_system("membrane", Membrane)
    yield
    SYSTEMS._registered.pop("membrane")


@pytest.fixture
def scene(tmp_path: Path) -> str:
    """An endoscope whose tip is beside the middle of a membrane."""
    arms = {"ecm_0": {"arm": "ecm", "position": [0.0, 0.0, 0.15], "workspace": [0.0, 0.0, -0.12]}}
    systems = {"membrane": {"type": "membrane", "position": [BESIDE, 0.0, 0.05]}}
    (tmp_path / "membrane.yaml").write_text(yaml.safe_dump({"arms": arms, "systems": systems}))
    return str(tmp_path / "membrane.yaml")


def pushed(engine: Any) -> list[np.ndarray]:
    """Return heights and joints once the arm of the first environment has pushed the membrane, and the other not."""
    engine.reset(seed=0)
    ctrl = np.array(engine.read(".physics.arms.ctrl", "numpy"))
    ctrl[:, 0] = PUSH, -PUSH
    engine.write(".physics.arms.ctrl", ctrl)
    for _ in range(TIMES):
        engine.step({})
    return [engine.read(f".physics.{part}", "numpy") for part in ("membrane.height", "arms.qpos")]


def physics(scene: str) -> PhysicsAlone:
    return PhysicsAlone(Env("reach", scene), steps=STEP)


class Emulated:
    """A block stage that JAX computes from an engine's arrays, where there is no GPU."""

    @staticmethod
    def relax(height: Any, speed: Any, middle: Any, part: Any, normal: Any, *rest: Any) -> Nodes:
        return relax(Nodes(height, speed), middle, part, normal, Response(*rest[:3]), *rest[3:])

    def __init__(self, engine: Any, stage: Any) -> None:
        self.engine, self.stage = engine, stage

    def read(self, leaf: Leaf) -> Any:
        if leaf.buffer in BUFFERS:
            return self.engine._arrays.read(leaf, "numpy")
        table = self.engine.source.tables[leaf.buffer][leaf.first : leaf.first + leaf.size]
        return np.repeat(table.reshape(1, *leaf.shape), ENVS, 0)

    def launch(self, *_: Any) -> None:
        reference = press if self.stage.name == "press" else self.relax
        results = jax.vmap(reference)(*map(self.read, self.stage.reads.values()))
        for leaf, values in zip(self.stage.writes.values(), jax.tree.leaves(results), strict=True):
            self.engine._arrays.write(leaf, values)


def pushed_as_on_a_gpu(env: PhysicsAlone) -> tuple[list[np.ndarray], list[Any]]:
    """Run the thread stages of a GPU on a CPU, and block stages by JAX; return what `pushed` does, and the stages."""
    with gpu_code(), patch.object(fused_engine, "compile_block", lambda *_: None):
        engine: Any = fused_engine.FusedEngine(env, ENVS, "cpu")
        blocks = [one for one in all_stages(engine.source.stages) if one.kind == "block"]
        engine._blocks = {stage.name: Emulated(engine, stage) for stage in blocks}
        return pushed(engine), engine.source.stages


def test_engines_move_it_alike(scene: str) -> None:
    env = physics(scene)
    expected = pushed(MjxEngine(env, ENVS, "cpu"))
    assert expected[0][0, MIDDLE].min() > 2e-3 and not expected[0][1].any()
    split, (first, *copies, loop, last) = pushed_as_on_a_gpu(env)
    for found in (split, pushed(fused_engine.FusedEngine(env, ENVS, "cpu"))):
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, atol=2e-6)
    assert (first.kind, last.kind, loop.kind, loop.length) == ("thread", "thread", "loop", STEP)
    assert [stage.name for stage in loop.stages if stage.kind == "block"] == ["press", "relax"]
    moved = [stage for stage in loop.stages if stage.kind == "copy"]
    assert len(copies) == 2 and [one.writes for one in copies] == [one.writes for one in moved]
    assert loop.stages[-3].kind == "thread" and set(moved[0].reads.values()) <= set(loop.stages[-4].writes.values())


@pytest.mark.skipif(not kernel.has_cuda(), reason="needs a CUDA device")
def test_a_gpu_moves_it_alike(scene: str) -> None:
    env = physics(scene)
    engines = fused_engine.FusedEngine(env, ENVS, "cuda"), MjxEngine(env, ENVS, "cpu")
    for one, other in zip(*map(pushed, engines), strict=True):
        np.testing.assert_allclose(one, other, atol=5e-6)


def test_a_kernel_reads_and_writes_what_it_declares(tmp_path: Path) -> None:
    """NVRTC compiles it without a GPU."""
    tables = {"middle": Leaf("int32", 5, (4,), "int32"), "dt": Leaf("float32", 11, (), "float32")}
    state = {"state.height": 0, "state.speed": 64, "normal": 130, "response.force": 154, "response.solved": 178,
             "accelerations": 186}  # fmt: skip
    reads = {name: Leaf("state", first, (24,), "float32") for name, first in state.items()}
    part = {"part": Leaf("counts", 7, (8,), "int32")}
    writes = {"height": Leaf("state", 210, (64,), "float32"), "speed": Leaf("outs", 87, (64,), "float32")}
    body = block_code(RELAX, 64, reads | tables | part, writes)
    assert "reals.data + 11, 1, 1" in body and "outs.data + (size_t)87 * stride + t), (size_t)stride, 64" in body
    module = kernel.wp.get_module("surgical_marl_test_stage")
    module.options.update(enable_backward=False)
    kernel._make("relax", body, module, threads=64)
    module.options["block_dim"] = 64
    (ptx,) = kernel.wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    assert ".shared" in (text := ptx.read_text()) and "bar.sync" in text
