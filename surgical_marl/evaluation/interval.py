"""Compute 95 % confidence intervals of metrics; docs/evaluation.md has the method for each kind of metric."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np

from surgical_marl.evaluation.metrics import Metric

CONFIDENCE = 0.95
RESAMPLES = 2000
TAILS = (0.5 - CONFIDENCE / 2, 0.5 + CONFIDENCE / 2)

Interval = list[float] | None
"""[low, high]; None where there is none."""


def interval(metric: Metric) -> Interval:
    """Return the 95 % interval of a metric over R runs of E episodes, with the same goals in every run.

    Of one run it says what other goals would change, not what another training seed would: Clopper-Pearson where each
    value is 0 or 1 and the metric is a share, else a percentile bootstrap of episodes. The arms of an episode stay
    together. Of several runs it is `over_seeds` of theirs.

    Returns:
        [low, high]; None for a single episode, where all values are equal and the metric is no share, or where a
        resample leaves the metric undefined. The same values always give the same interval.
    """
    runs = [metric._replace(values=values) for values in metric.values]
    values = [float(run.reduce(run.values.ravel())) for run in runs]
    return over_seeds(values, [_over_episodes(run) for run in runs], 1.0 if metric.share else np.inf)


def share_interval(share: float, episodes: int) -> list[float]:
    """Return the Clopper-Pearson interval of a share of independent episodes, [low, high].

    Args:
        share: from 0 to 1. Over several arms it need not be a whole number of episodes: arms of an episode are not
            independent, so they count as parts of it.
        episodes: how many there were, 1 or more.
    """
    from scipy.special import betaincinv  # takes half a second to import

    hits, misses = share * episodes, (1 - share) * episodes
    low = betaincinv(hits, misses + 1, TAILS[0]) if hits else 0.0
    high = betaincinv(hits + 1, misses, TAILS[1]) if misses else 1.0
    return [float(low), float(high)]


def over_seeds(values: Sequence[float], intervals: Sequence[Interval], most: float = np.inf) -> Interval:
    """Return the 95 % interval of the mean of a metric over training seeds; of one seed, its own interval.

    Two distances to each bound are added as squares (Zou and Donner, Stat. Med. 27(10), 2008): half of the t interval
    of the seeds' values, and the mean distance of the seeds' own bounds. The latter does not shrink with the number of
    seeds, because all of them play the same goals.

    Args:
        values: of the metric, one for each seed.
        intervals: over episodes, one for each seed.
        most: the largest value that the metric can have. Bounds do not leave 0 on its other side either.

    Returns:
        [low, high]; None if a seed has no interval.
    """
    known = [each for each in intervals if each is not None]
    if len(known) < len(intervals):
        return None
    if len(known) == 1:
        return known[0]
    from scipy.special import stdtrit

    mean, bounds = np.mean(values), np.array(known)
    spread = stdtrit(len(values) - 1, TAILS[1]) * np.std(values, ddof=1) / np.sqrt(len(values))
    below, above = np.hypot(bounds.mean(0) - mean, spread)
    low, high = float(mean - below), min(float(mean + above), most)
    if (bounds >= 0).all():
        return [max(low, 0.0), high]
    return [low, min(high, 0.0) if (bounds <= 0).all() else high]


def _over_episodes(run: Metric) -> Interval:
    """Return the interval of a metric of one run, from its values [E, A]."""
    episodes, value = len(run.values), float(run.reduce(run.values.ravel()))
    if episodes < 2 or not np.isfinite(value):
        return None
    known = ~np.isnan(run.values)
    if run.share and np.isin(run.values[known], (0, 1)).all():
        return share_interval(value, int(known.any(-1).sum()))
    from scipy.stats import DegenerateDataWarning, bootstrap  # takes a second to import

    def statistic(drawn: np.ndarray, axis: int) -> np.ndarray:
        values = run.values[drawn.astype(int)]
        return run.reduce(values.reshape(*values.shape[:-2], -1))

    options: dict[str, Any] = {"n_resamples": RESAMPLES, "batch": 100, "vectorized": True, "axis": -1}
    options |= {"confidence_level": CONFIDENCE, "method": "percentile", "rng": np.random.default_rng(0)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)  # an undefined resample: None below
        found = bootstrap((np.arange(episodes),), statistic, **options)
    low, high = (float(bound) for bound in found.confidence_interval)
    return [low, high] if np.isfinite([low, high]).all() and low < high else None
