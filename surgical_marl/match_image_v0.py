"""PettingZoo's way to name a version of a task: `from surgical_marl import match_image_v0;
match_image_v0.parallel_env(scene="ecm")`."""

from __future__ import annotations

from functools import partial

from surgical_marl.interfaces import pettingzoo

parallel_env = partial(pettingzoo.parallel_env, "match_image")
env = raw_env = partial(pettingzoo.aec_env, "match_image")
