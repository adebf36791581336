"""PettingZoo's way to name a version of a task: `from surgical_marl import track_v0;
track_v0.parallel_env(scene="psm")`."""

from __future__ import annotations

from functools import partial

from surgical_marl.interfaces import pettingzoo

parallel_env = partial(pettingzoo.parallel_env, "track")
env = raw_env = partial(pettingzoo.aec_env, "track")
