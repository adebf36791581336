"""MAPPO: agents of a type share a network, and the critic sees the whole state."""

from surgical_marl.learning.algorithm import Algorithm


class MAPPO(Algorithm):
    """Multi-agent PPO with a critic of the whole state (Yu et al. 2022, arXiv 2103.01955)."""
