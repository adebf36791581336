"""Where the arms of a policy fail: at a joint's limit, near a singularity, or elsewhere.

    python -m docs.studies.failures RUN_OR_POLICY [--start random] [--episodes 4000]

It plays held-out episodes of `reach`, `track` or `follow_path` and prints a table. Each row of the table of goals
counts once, however often it is drawn. Where targets move, postures up to the first miss are looked at, otherwise the
last.
"""

from __future__ import annotations

import sys
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from docs.studies.command import make_parser, run
from surgical_marl.cli.flags import whole
from surgical_marl.evaluation.environment import common_settings, find_policy
from surgical_marl.evaluation.evaluate import MAX_BATCH
from surgical_marl.evaluation.goal_set import episode_seed
from surgical_marl.policies.policy import load_policy
from surgical_marl.runs.settings import make_env

if TYPE_CHECKING:
    from surgical_marl.envs.batch import BatchedEnv
    from surgical_marl.robots.arm import Arm

AT_LIMIT = 0.005
"""A joint is at its limit if it is nearer to it than this share of its range."""
STRETCHED = 0.5
"""An arm is near a singularity if the tip's slowest direction, at unit speed of the joints, has less than this share of
the speed that it has at home."""
NEAR, FAR = 0.002, 0.03
"""A tip fails if it is further from its target than the first, and is lost if it is further than the second, m."""
PLACES = ("at a joint's limit", "near a singularity", "elsewhere")
LAST = 10
"""Steps at the end of an episode that count where targets rest."""


class Found(NamedTuple):
    """What arms did in episodes."""

    place: np.ndarray
    """[E, A], number in `PLACES`."""
    off: np.ndarray
    """[E, A], the largest error that counts, m."""


def main(argv: list[str] | None = None) -> int:
    parser = make_parser(__doc__)
    parser.add_argument("policy", metavar="RUN_OR_POLICY")
    parser.add_argument("--start", help="default: the policy's own")
    parser.add_argument(
        "--episodes", type=whole(1, 1_000_000), default=4000, metavar="N", help="to draw (default: 4000)"
    )
    asked = parser.parse_args(argv)
    settings = common_settings([asked.policy], {"start": asked.start, "goals": "held_out"})
    env = make_env(settings, min(asked.episodes, MAX_BATCH))
    print(table(look(env, load_policy(find_policy(asked.policy), env), asked.episodes)))
    return 0


def look(env: BatchedEnv, policy: Any, episodes: int) -> Found:
    """Play about so many episodes, and return what happened in each that differs from the others.

    ValueError if goals are no rows of a table.
    """
    rows, places, errors = [], [], []
    for block in range(-(-episodes // env.num_envs)):
        observations, *_ = env.reset(episode_seed(0, block))
        goal = vars(env.goal)
        if "row" not in goal:
            raise ValueError(f"goals of {env.task_name} from {env.task.starts_at} are no rows: try --start random")
        rows.append(np.array(goal["row"]))
        qpos, off = [], []
        for _ in range(env.max_steps):
            qpos.append(np.array(env.qpos, float))
            step = env.step(policy(observations))
            observations = step.observations
            off.append(np.stack([np.asarray(step.infos[agent]["tip_error"]) for agent in env.agents], -1))
        steps = np.stack(off)
        judged = np.ones(len(steps), bool) if env.task.follows else np.arange(len(steps)) >= len(steps) - LAST
        before = judged[:, None, None] & (np.cumsum(steps * judged[:, None, None] >= NEAR, 0) <= 1)
        places.append(_places(env, np.stack(qpos), before))
        errors.append(steps[judged].max(0))
    _, first = np.unique(np.concatenate(rows), return_index=True)
    return Found(np.concatenate(places)[first], np.concatenate(errors)[first])


def table(found: Found) -> str:
    """Return how often arms are in each of `PLACES`, and how many of them fail and are lost there."""
    lines = ["| where | arms | fail | lost |", "|---|---|---|---|"]
    for number, place in enumerate((*PLACES, "all")):
        off = found.off[(found.place == number) | (place == "all")]
        shares = [len(off) / found.off.size, np.mean(off >= NEAR) if off.size else 0.0]
        lines.append(f"| {place} | {shares[0]:.1%} of {found.off.size:,} | {shares[1]:.1%} | {(off >= FAR).sum()} |")
    return "\n".join(lines)


def _places(env: BatchedEnv, qpos: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Return the numbers in `PLACES` [N, A] of joint positions [T, N, nq], looking at the steps `where` [T, N, A]."""
    found = []
    for number, agent in enumerate(env.agents):
        arm, own = env.scene.mounts[agent].arm, where[..., number]
        q = qpos[..., env.scene.qpos_index(agent)]
        at_limit = (_room(arm, q) < AT_LIMIT) & own
        stretched = (_slowest(arm, q) < STRETCHED * _slowest(arm, arm.home)) & own
        found.append(np.where(at_limit.any(0), 0, np.where(stretched.any(0), 1, 2)))
    return np.stack(found, -1)


def _room(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the least distance of a joint that moves the tip to its limits, [...], in shares of its range."""
    moves = np.any(arm.jacobian(arm.home)[:3] != 0, axis=0)
    share = (q - arm.lower) / (arm.upper - arm.lower)
    return np.minimum(share, 1 - share)[..., moves].min(-1)


def _slowest(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the least singular value of the tip's velocity in those of the joints, [...]."""
    return np.linalg.svd(arm.jacobian(q)[..., :3, :], compute_uv=False)[..., -1]


if __name__ == "__main__":
    sys.exit(run("failures", main))
