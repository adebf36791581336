"""PettingZoo's way to name a version of a task: `from surgical_marl import follow_path_v0;
follow_path_v0.parallel_env(scene="psm")`."""

from __future__ import annotations

from functools import partial

from surgical_marl.interfaces import pettingzoo

parallel_env = partial(pettingzoo.parallel_env, "follow_path")
env = raw_env = partial(pettingzoo.aec_env, "follow_path")
