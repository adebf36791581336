"""Steps all scenes with extreme actions, gains, payloads, objects and control steps, and looks for what must not be.

Run: python -m docs.studies.numbers --steps 10000000 --seed 0

Every scene is stepped as it ships; and "wild": gains, damping and friction off by 90 %, masses of 0.5 kg at the tool
tips, backlash, noise and latency, objects of other size, mass and friction. A wild scene's control step is 1, 4 or 20
physics steps, by the seed. Found faults are written to --out, for `surgical-marl replay`.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surgical_marl import list_scenes, list_tasks, load_scene
from surgical_marl.content import find
from surgical_marl.engines.fused.kernel import compile_kernels
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.envs.state import BatchStep
from surgical_marl.plugins.tasks import TASKS
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.runs.fault import write_fault
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.poses import Poses
from surgical_marl.scenes.scene import Scene
from surgical_marl.yaml_file import dump_yaml, read_yaml

COUNT = 1024
"""Environments at once."""
CHUNK = 25
"""Steps between changes of how an environment is driven."""
WILD = {
    "offset_angle": 0.05, "offset_slide": 0.005, "backlash_angle": 0.02, "backlash_slide": 0.002,
    "noise_angle": 0.02, "noise_slide": 0.002, "stiffness": 0.9, "damping": 0.9, "friction": 0.9, "payload": 0.5,
    "latency": 3,
}  # fmt: skip
WILD_OBJECTS = {"object_shift": 0.01, "object_turn": 3.14, "object_size": 0.5, "object_mass": 0.9,
                "object_friction": 0.9}  # fmt: skip
WILD_IN_PLACE = {"object_mass": 0.9, "object_friction": 0.9}
"""For objects that stand around pegs."""
DECIMATIONS = (1, 4, 20)
MARGIN = 0.002
"""What is nearer to the rim of a box than this, m, may pass it beside it."""


@dataclass
class Found:
    """What a scene's steps led to."""

    steps: int = 0
    faults: int = 0
    tunnels: int = 0
    """Objects that have got to the other side of a fixed box within its rim."""
    overflows: int = 0
    """Steps of an environment in which contacts were left out, which the infos say."""
    unfelt: int = 0
    """Pairs that overlap by more than 0.5 mm before a step and no less after it without a force in it, though no
    contact was said to be left out. Those that part fast enough need no force."""
    deepest: float = 0.0
    """Largest overlap of any pair, m."""
    seconds: float = 0.0

    def row(self, name: str) -> str:
        """Return a line of the table."""
        rate = self.steps / self.seconds if self.seconds else 0
        return (
            f"| {name} | {self.steps:,} | {self.faults} | {self.tunnels} | {self.overflows} | {self.unfelt} | "
            f"{1000 * self.deepest:.1f} | {rate:,.0f} |"
        )


class Floors:
    """The boxes of a scene's fixed objects, and on which side of their middle free objects are."""

    def __init__(self, scene: Scene) -> None:
        model, data = scene.model, mujoco.MjData(scene.model)
        mujoco.mj_kinematics(model, data)

        def of(name: str) -> list[int]:
            return [g for g in range(model.ngeom) if model.geom_bodyid[g] == model.body(name).id]

        fixed = [g for name in scene.objects if name not in scene.free_objects for g in of(name)]
        boxes = [g for g in fixed if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
        self._centers, self._sizes = data.geom_xpos[boxes], model.geom_size[boxes]
        self._axes = data.geom_xmat[boxes].reshape(-1, 3, 3)
        self._ends = [np.concatenate([_ends(model, g) for g in of(name)]) for name in scene.free_objects]
        self._before: list[Any] = [0] * len(self._ends)

    def passed(self, poses: Poses, ended: np.ndarray) -> int:
        """Return how many objects have got to a box's other side since the last call, without leaving its rim.

        Args:
            poses: of the free objects, [N, k].
            ended: where an episode has just ended, [N] bool: the poses are of the next one.
        """
        count = 0
        for k, ends in enumerate(self._ends):
            points = _turned(poses.quaternion[:, k, None], ends) + poses.origin[:, k, None]
            local = np.einsum("nebi,bij->nebj", points[:, :, None] - self._centers, self._axes)
            within = (np.abs(local[..., :2]) < self._sizes[:, :2] - MARGIN).all((1, 3)) & ~ended[:, None]
            side = np.where((local[..., 2] > 0).all(1), 1, np.where((local[..., 2] < 0).all(1), -1, 0))
            count += int((within & (side * self._before[k] < 0)).sum())
            self._before[k] = np.where(within, np.where(side == 0, self._before[k], side), 0)
        return count


def _turned(quaternion: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points turned by unit quaternions, [N, 1, 4] and [n, 3] to [N, n, 3]."""
    axis = np.broadcast_to(quaternion[..., 1:], (len(quaternion), *points.shape))
    once = np.cross(axis, points)
    return np.asarray(points + 2 * (quaternion[..., :1] * once + np.cross(axis, once)))


def _ends(model: Any, geom: int) -> np.ndarray:
    """Return both ends of a capsule, the corners of a box, or the centre of a sphere, in its body's frame, [n, 3]."""
    kind, size = model.geom_type[geom], model.geom_size[geom]
    axes, at = matrix_of(model.geom_quat[geom]), model.geom_pos[geom]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([at + way * size[1] * axes[:, 2] for way in (-1, 1)])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        corners = np.stack(np.meshgrid(*[(-1, 1)] * 3), -1).reshape(-1, 3) * size
        return np.array(at + corners @ axes.T)
    return np.array(at)[None]


def drives(env: BatchedEnv, rng: np.random.Generator) -> Iterator[dict[str, np.ndarray]]:
    """Yield extreme actions without end: each environment is driven in one of several ways for some steps."""
    size, count = sum(space.shape[0] for space in env.action_spaces.values()), env.num_envs
    ends = np.cumsum([space.shape[0] for space in env.action_spaces.values()])[:-1]
    while True:
        way = rng.integers(0, 6, (count, 1))
        corner, sign = rng.choice([-1.0, 1.0], (count, size)), 1.0
        for _ in range(CHUNK):
            sign = -sign
            noise, bang = rng.uniform(-1, 1, (count, size)), rng.choice([-1.0, 1.0], (count, size))
            every = np.choose(way, [noise, bang, corner, sign * corner, 3e38 * corner, 0.01 * noise])
            yield dict(zip(env.agents, np.split(every.astype(np.float32), ends, axis=1), strict=True))


def fuzz(settings: Settings, steps: int, seed: int, out: Path, count: int = COUNT) -> Found:
    """Step the environments of settings so many times in all, and return what was found.

    Faults are written into the folder `out`.
    """
    env = BatchedEnv(**settings.of_environment(), num_envs=count, engine=settings.engine, device="cpu")
    env.reset(seed=seed)
    env.steps = np.random.default_rng(seed).integers(0, env.max_steps, count)
    found, watch, began = Found(), Watch(env), time.perf_counter()
    start, done = env.carry(), list[dict[str, np.ndarray]]()
    for number, actions in zip(range(-(-steps // count)), drives(env, np.random.default_rng(seed)), strict=False):
        if number % CHUNK == 0:
            start, done = env.carry(), []
        done.append(actions)
        step = env.step(actions)
        watch.look(found, step)
        if (step.faults >= 0).any():
            _keep(out, env, settings, start, done, step, seed)
    found.seconds = time.perf_counter() - began
    env.close()
    return found


class Watch:
    """Looks at each step of an environment."""

    def __init__(self, env: BatchedEnv) -> None:
        self._env, self._floors = env, Floors(env.scene)
        self._before: Any = np.inf
        """Distances at the end of the last step, m."""

    def look(self, found: Found, step: BatchStep) -> None:
        """Count what must not be after a step."""
        ended = np.asarray(step.terminated | step.truncated)
        found.steps += self._env.num_envs
        found.faults += int((step.faults >= 0).sum())
        overflow = np.asarray(next(iter(step.infos.values()))["contact_overflow"])
        found.overflows += int((overflow > 0).sum())
        distance, depth, force = (np.asarray(getattr(step.contacts, of)) for of in ("distance", "penetration", "force"))
        found.deepest = max(found.deepest, float(np.max(depth, initial=0.0)))
        # distances are of the end of a step: a force can only be in the next one
        held = (self._before < -5e-4) & (distance <= self._before)
        found.unfelt += int((held & (force == 0) & (overflow == 0)[:, None]).sum())
        self._before = np.where(ended[:, None], np.inf, distance)
        found.tunnels += self._floors.passed(self._env.object_poses, ended)


def _keep(out: Path, env: BatchedEnv, settings: Settings, start: Any, done: Any, step: BatchStep, seed: int) -> None:
    """Write the first fault of a step."""
    index = int(np.flatnonzero(step.faults >= 0)[0])
    place = str(env.fault_place(step.faults[index]))
    path = out / f"fault-{Path(settings.scene).stem}-{seed}-{index}.npz"
    if not path.exists():
        one = {name: value[index : index + 1] for name, value in start.items()}
        actions = {agent: np.stack([each[agent][index : index + 1] for each in done]) for agent in env.agents}
        write_fault(path, env, settings, one, actions, seed=seed, index=index, place=place)
        print(f"{path}: {place}", flush=True)


def cases(folder: Path, seed: int, only: Sequence[str] | None = None, plain: bool = False) -> dict[str, Settings]:
    """Return what is stepped, by name: every scene with the task that has it as its own, as it ships and wild.

    Args:
        folder: for the wild scenes.
        seed: which control step a wild scene has.
        only: names of scenes; None for all.
        plain: whether to leave wild scenes out.
    """
    found = {}
    own = {TASKS.load(task).default_scene: task for task in reversed(list_tasks()) if not _looks(task)}
    for number, scene in enumerate(list_scenes()):
        if only is not None and scene not in only:
            continue
        task = own.get(scene, "reach")
        found[scene] = Settings(task=task, scene=scene)
        if not plain:
            decimation = DECIMATIONS[(seed + number) % len(DECIMATIONS)]
            wild = str(_write_wild(folder, scene))
            found[f"{scene}, wild, {decimation}"] = Settings(task=task, scene=wild, decimation=decimation)
    return found


def _write_wild(folder: Path, scene: str) -> Path:
    """Write a scene with wild ranges: its objects begin where they are if they would overlap others elsewhere."""
    about, path = read_yaml(find("scenes", scene)), folder / f"{scene}-wild.yaml"
    ranges = [WILD_OBJECTS, WILD_IN_PLACE] if load_scene(scene).free_objects else [{}]
    for objects in ranges:
        path.write_text(dump_yaml({**about, "randomisation": WILD | objects}), encoding="utf-8")
        try:
            load_scene(str(path))
            break
        except ValueError:
            if objects is ranges[-1]:
                raise
    return path


def cost(only: Sequence[str] | None) -> None:
    """Print what the check of every step takes: steps with and without it take turns.

    Without it the kernels don't look at what they store, and nothing looks at the environments after a step.
    """
    print("| environments | us without | us with | |\n|---|---|---|---|", flush=True)
    measured = (("psm", 1), ("psm", COUNT), ("bimanual_psm", COUNT), ("bimanual_psm_needle", COUNT))
    for scene, count in [case for case in measured if only is None or case[0] in only]:
        env, bare = (BatchedEnv("reach", scene, num_envs=count, engine="fused", device="cpu") for _ in range(2))
        engine: Any = bare.engine
        bodies = {
            name: "\n".join(line for line in body.splitlines() if "watch_" not in line)
            for name, body in engine.source.bodies.items()
        }
        engine._kernels = compile_kernels(bodies, "cpu", count)
        fine = np.full(count, -1, np.int32)
        engine.end_faulty = lambda limit, library, fine=fine: fine
        env.reset(seed=0), bare.reset(seed=0)
        actions = next(drives(env, np.random.default_rng(0)))
        taken: tuple[list[float], list[float]] = [], []
        for number in range(3000 if count > 1 else 40_000):
            began = time.perf_counter()
            (bare, env)[number % 2].step(actions)
            taken[number % 2].append(1e6 * (time.perf_counter() - began))
        without, with_it = (float(np.quantile(own, 0.1)) for own in taken)
        print(
            f"| {count:,} of `{scene}` | {without:,.1f} | {with_it:,.1f} | {with_it / without - 1:+.1%} |", flush=True
        )
        for own in (env, bare):
            own.close()


def _looks(task: str) -> bool:
    """Return whether a task is about pictures, which take time and are no numbers of the physics."""
    return bool(getattr(TASKS.load(task), "senses", ()))


def main(argv: Sequence[str] | None = None) -> None:
    """Step all cases, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000_000, help="of all environments of all cases together")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path(), help="folder for faults that are found")
    parser.add_argument("--only", nargs="*", metavar="SCENE", help="these scenes alone")
    parser.add_argument("--plain", action="store_true", help="scenes as they ship alone")
    parser.add_argument("--cost", action="store_true", help="say what the check of every step takes instead")
    arguments = parser.parse_args(argv)
    if arguments.cost:
        cost(arguments.only)
        return
    print("| scene | steps | faults | tunnels | steps with contacts left out | unfelt | deepest, mm | steps/s |")
    print("|---|---|---|---|---|---|---|---|", flush=True)
    with tempfile.TemporaryDirectory() as folder:
        wanted = cases(Path(folder), arguments.seed, arguments.only, arguments.plain)
        for name, settings in wanted.items():
            print(fuzz(settings, arguments.steps // len(wanted), arguments.seed, arguments.out).row(name), flush=True)


if __name__ == "__main__":
    main()
