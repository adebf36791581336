"""What a soak steps: a training, each face, and environments that are made and closed, each without an end.

    python -m docs.studies.soak_faces gymnasium --out runs/soak

Each is a process of its own. It counts its steps in a file that is mapped into memory, so that counting costs nothing.
"""

from __future__ import annotations

import argparse
import ctypes
import mmap
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import closing
from itertools import cycle
from pathlib import Path

import numpy as np

from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.runs.folder import METRICS
from surgical_marl.runtime import jax, jnp

TASK, SCENE = "reach", "psm"
ID = "surgical_marl:surgical_marl/Reach-v0"
COUNT = {"cpu": 64, "cuda": 4096}
"""Environments side by side on each device, of faces that have many."""
DRAWN = 97
"""Steps until the same random actions come again."""
_PR_SET_PDEATHSIG = 1


def parallel(device: str) -> Iterator[int]:
    """PettingZoo, one environment."""
    import surgical_marl as sm

    with closing(sm.parallel_env(TASK, scene=SCENE, device=device)) as env:
        given = cycle([{agent: own[0] for agent, own in each.items()} for each in _actions(env.batch, 1)])
        env.reset(seed=0)
        while True:
            env.step(next(given))
            yield 1
            if not env.agents:
                env.reset()


def gymnasium(device: str) -> Iterator[int]:
    """Gymnasium, one environment."""
    import gymnasium as gym

    with closing(gym.make(ID, scene=SCENE, device=device)) as env:
        given = cycle(_drawn(*(env.action_space.shape or ())))
        env.reset(seed=0)
        while True:
            _, _, terminated, truncated, _ = env.step(next(given))
            yield 1
            if terminated or truncated:
                env.reset()


def gymnasium_vector(device: str) -> Iterator[int]:
    """Gymnasium, many environments."""
    import gymnasium as gym

    with closing(gym.make_vec(ID, scene=SCENE, num_envs=COUNT[device], device=device)) as env:
        given = cycle(_drawn(*(env.action_space.shape or ())))
        env.reset(seed=0)
        while True:
            env.step(next(given))
            yield COUNT[device]


def rsl_rl(device: str) -> Iterator[int]:
    """rsl_rl, whose face training uses."""
    import torch

    from surgical_marl.interfaces.rsl_rl import RslRlVecEnv

    with closing(RslRlVecEnv(_batched("torch", device), seed=0)) as env:
        given = cycle(torch.from_numpy(_drawn(env.num_envs, env.num_actions)).to(device))
        while True:
            env.step(next(given))
            yield COUNT[device]


def torchrl(device: str) -> Iterator[int]:
    """TorchRL, stepped as its collectors do."""
    import torch

    from surgical_marl.interfaces.torchrl import TorchRLEnv

    with closing(TorchRLEnv(_batched("torch", device))) as env, torch.no_grad():
        env.set_seed(0)
        data = env.reset()
        while True:
            _, data = env.step_and_maybe_reset(env.rand_action(data))
            yield COUNT[device]


def jax_functions(device: str) -> Iterator[int]:
    """JAX, many environments by `jit` and `vmap`."""
    from surgical_marl.interfaces.jax_env import jax_env

    env, count = jax_env(TASK, SCENE), COUNT[device]
    with jax.default_device(jax.devices(device)[0]):
        _, state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), count))
        sizes = {agent: env.action_space(agent).shape for agent in env.agents}
        given = cycle([{agent: jnp.asarray(_drawn(count, *size)[0]) for agent, size in sizes.items()}])
        step = jax.jit(jax.vmap(env.step, in_axes=(None, 0, 0)))
        while True:
            _, state, rewards, _, _ = step(None, state, next(given))
            jax.block_until_ready(rewards)
            yield count


def batched(device: str) -> Iterator[int]:
    """`BatchedEnv`, which is below all faces but that of JAX."""
    with closing(_batched("numpy", device)) as env:
        given = cycle(_actions(env, COUNT[device]))
        env.reset(0)
        while True:
            env.step(next(given))
            yield COUNT[device]


def made(device: str) -> Iterator[int]:
    """Environments that are made, stepped three times and closed, of one face after the other; these are counted."""
    for face in cycle([parallel, gymnasium, gymnasium_vector, rsl_rl, batched]):
        steps = face(device)
        for _ in range(3):
            next(steps)
        steps.close()  # type: ignore[attr-defined]  # generators
        yield 1


FACES: dict[str, Callable[[str], Iterator[int]]] = {
    "parallel": parallel, "gymnasium": gymnasium, "gymnasium_vector": gymnasium_vector, "rsl_rl": rsl_rl,
    "torchrl": torchrl, "jax": jax_functions, "batched": batched, "made": made,
}  # fmt: skip
ALL = ("train", *FACES)


def _batched(arrays: str, device: str) -> BatchedEnv:
    return BatchedEnv(TASK, SCENE, num_envs=COUNT[device], device=device, arrays=arrays)


def _drawn(*shape: int) -> np.ndarray:
    """Return actions in [-1, 1] of some steps, [DRAWN, ...] float32."""
    return np.random.default_rng(0).uniform(-1, 1, (DRAWN, *shape)).astype(np.float32)


def _actions(env: BatchedEnv, count: int) -> list[dict[str, np.ndarray]]:
    """Return the actions of all agents for some steps, [count, n] each."""
    drawn = {agent: _drawn(count, *(env.action_space(agent).shape)) for agent in env.agents}
    return [{agent: own[number] for agent, own in drawn.items()} for number in range(DRAWN)]


def counter(out: Path, name: str) -> mmap.mmap:
    """Return the file in which a process counts its steps, as memory of 8 bytes; it is made if it is missing."""
    path = out / f"{name}.count"
    if not path.exists():
        path.write_bytes(bytes(8))
    with path.open("r+b") as file:
        return mmap.mmap(file.fileno(), 8)


def counted(out: Path, name: str) -> int:
    """Return how many steps a process has made; of a training, what its last row of metrics says."""
    if name != "train":
        with counter(out, name) as memory:
            return int.from_bytes(memory[:], "little")
    path = out / name / METRICS
    if not path.is_file():
        return 0
    with path.open("rb") as file:
        names = file.readline().decode().split(",")
        begin = max(file.tell(), path.stat().st_size - 4000)
        file.seek(begin - 1)
        rows = file.read().decode().split("\n")[1:-1]  # without parts of a row
    return int(float(rows[-1].split(",")[names.index("env_steps")])) if rows else 0


def step_forever(name: str, out: Path, device: str) -> int:
    """Step one of `ALL` on "cpu" or "cuda" until the process is ended; with its parent at the latest."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if name == "train":
        from surgical_marl.cli.main import main

        size = ["--num-envs", str(COUNT[device]), "--iterations", "10000000", "--device", device]
        return main(["train", TASK, "--scene", SCENE, *size, "--out", str(out / name)])
    memory, total = counter(out, name), 0
    for steps in FACES[name](device):
        total += steps
        memory[:] = total.to_bytes(8, "little")
    return 0


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("name", choices=ALL)
    parser.add_argument("--device", choices=tuple(COUNT), default="cpu")
    parser.add_argument("--out", type=Path, default=Path("runs/soak"), metavar="DIR")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    sys.exit(step_forever(arguments.name, arguments.out, arguments.device))
