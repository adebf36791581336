"""Joint PPO: one agent observes and moves all arms."""

from surgical_marl.learning.algorithm import Algorithm


class JointPPO(Algorithm):
    """PPO of one agent that observes and moves all arms (Schulman et al. 2017, arXiv 1707.06347)."""

    grouping = "joint"
