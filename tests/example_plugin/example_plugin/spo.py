"""An algorithm of another package: simple policy optimisation (Xie et al. 2025, ICML, arXiv 2401.16025)."""

from torch import Tensor

from surgical_marl.learning.algorithm import Algorithm


class SPO(Algorithm):
    """PPO with a quadratic penalty on the ratio in place of the clip, so that every sample keeps a gradient."""

    def surrogate(self, ratio: Tensor, advantages: Tensor) -> Tensor:
        """Return what each action is worth: the most where its ratio is `clip` above or below 1."""
        return ratio * advantages - advantages.abs() / (2 * self.clip_param) * (ratio - 1).square()
