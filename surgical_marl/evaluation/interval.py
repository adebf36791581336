"""Confidence intervals by bootstrap (scipy)."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np

from surgical_marl.evaluation.metrics import Metric

CONFIDENCE = 0.95
RESAMPLES = 2000


def interval(metric: Metric) -> list[float] | None:
    """Return the 95 % percentile interval of a metric over R runs of E episodes, with the same goals in every run.

    Runs and episodes are resampled independently, each drawn run with each drawn episode (Owen, The pigeonhole
    bootstrap, Ann. Appl. Stat. 1(2), 2007). The arms of an episode stay together. If there is only one run, only
    episodes are resampled: the interval then says what other goals would change, not what another training seed would.

    Returns:
        [low, high]; None for a single episode, or where a resample leaves the metric undefined. The same values always
        give the same interval.
    """
    runs, episodes, _ = metric.values.shape
    if episodes < 2:
        return None
    from scipy.stats import DegenerateDataWarning, bootstrap  # takes a second to import

    def statistic(*drawn: np.ndarray, axis: int) -> np.ndarray:
        run, episode = (indices.astype(int) for indices in (drawn if runs > 1 else (np.zeros(1), *drawn)))
        values = metric.values[run[..., :, None], episode[..., None, :]]
        return metric.reduce(values.reshape(*values.shape[:-3], -1))

    options: dict[str, Any] = {"n_resamples": RESAMPLES, "batch": 100, "vectorized": True, "axis": -1}
    options |= {"confidence_level": CONFIDENCE, "method": "percentile", "rng": np.random.default_rng(0)}
    drawn_from = (np.arange(runs), np.arange(episodes)) if runs > 1 else (np.arange(episodes),)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DegenerateDataWarning)  # an undefined resample: None below
        found = bootstrap(drawn_from, statistic, **options)
    low, high = (float(bound) for bound in found.confidence_interval)
    return [low, high] if np.isfinite([low, high]).all() else None
