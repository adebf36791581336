"""IPPO: agents of a type share a network, and a critic that sees what its agent sees."""

from surgical_marl.learning.algorithm import Algorithm


class IPPO(Algorithm):
    """Independent PPO: each critic sees what its agent sees (de Witt et al. 2020, arXiv 2011.09533)."""

    central_critic = False
