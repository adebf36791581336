"""Metrics of whole episodes. docs/evaluation.md has each formula with its source."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

HOLD = 0.2
"""Time at the end of an episode in which the tip must stay near its goal, s."""
THRESHOLDS_MM = (1, 2, 5)
SUCCESS_MM = 2
"""The threshold of team success, and of the time to success where tool tips have targets."""
DROP = "drop"
"""True if an object was dropped or lost in a step, in `infos` of tasks with objects."""
TERMS = ("reward_", "cost")
"""Prefixes of the names of reward terms and costs in `infos`."""
STAGE = "stage_"
"""Prefix of the names of a task's stages there."""
SHARES = (STAGE, "cost_")
"""Prefixes of the names of `infos` that are 0 or 1 in each step."""
LAST = {
    "angle_error": ("angle_error_deg", 180 / math.pi),
    "image_error": ("image_error", 1.0),
    "goal_angle": ("goal_angle_deg", 180 / math.pi),
    "score": ("score", 1.0),
    "score_time": ("score_time_s", 1.0),
}
"""Infos of some agents whose value after the last step counts: name -> name and unit factor of the metric."""
VIEWED = {
    "in_view": ("in_view_rate", 1.0),
    "object_in_view": ("object_in_view_rate", 1.0),
    "centre_error": ("centre_error", 1.0),
}
"""Infos of the view of an endoscope, whose mean over the steps that are not `SEARCHING` counts, likewise."""
SEARCHING = "searching"
"""True if an endoscope may still look for the tools, in `infos` of tasks with such a search."""
TRAVEL = {"camera_travel": ("camera_travel_mm", 1000.0)}
"""Infos of how far something moved in a step, whose sum counts, likewise."""
BITES = {
    "entry_error": ("entry_error_mm", 1000.0),
    "exit_error": ("exit_error_mm", 1000.0),
    "bite_depth": ("bite_depth_mm", 1000.0),
    "tail_error": ("tail_error_mm", 1000.0),
    "gap": ("gap_mm", 1000.0),
}
"""Infos of a needle or a stitch whose value after the last step counts, likewise; of all episodes, their median."""
PEAK = {
    "contact_force": ("peak_force_n", 1.0),
    "tissue_force": ("max_tissue_force_n", 1.0),
    "tension": ("max_tension_n", 1.0),
}
"""Infos whose largest value of all steps counts, likewise."""
COURSES, POINTS = ("tissue_force", "tension"), 100
"""Infos that are the same for all agents, whose course over time is kept, at this many points at most."""
STILL = 1e-3
"""A tip that moved less than this, in m, has no smoothness, because its motion is noise."""


class Trajectory(NamedTuple):
    """E episodes of A arms, step by step. Steps after an episode's own length are ignored."""

    lengths: np.ndarray
    """[E], steps of each episode."""
    error: np.ndarray
    """[T, E, A], distance of tip, or object, and goal after each step, m; NaN in a task without such goals."""
    success: np.ndarray
    """[T, E, A] bool, success by the task's own measure, after each step."""
    missed: np.ndarray
    """[T, E, A] bool, not at the goal after each step: the time to success follows from it."""
    collision: np.ndarray
    """[T, E, A] bool, during each step."""
    distance: np.ndarray
    """[T, E, A], least distance to any other arm after each step, m; inf for an arm alone."""
    changes: np.ndarray
    """[T, E, A], mean square of how each step's action differs from that of the step before."""
    tip: np.ndarray
    """[T, E, A, 3], in the base frame at the start of each step, m."""
    center: np.ndarray
    """[T, E, A], distance of the shaft from its remote center at the start of each step, m; NaN without one."""
    terms: Mapping[str, np.ndarray]
    """Reward terms, costs, stages, `SEARCHING` and what `LAST`, `BITES`, `VIEWED`, `TRAVEL` and `PEAK` have, of each
    step, by their names in `infos`, [T, E, A]; NaN for an agent that has none."""


class Metric(NamedTuple):
    """A number over R runs of E episodes, reduced from one number per episode and arm."""

    values: np.ndarray
    """[R, E, A], or [R, E, 1] for a value of a whole episode."""
    reduce: Callable[[np.ndarray], np.ndarray]
    """[..., n] -> [...]"""
    extreme: bool = False
    """True if the metric is the worst value seen, for which a bootstrap can't give an interval."""
    share: bool = False
    """True if each value is from 0 to 1, so that the metric is a share of episodes or of their steps."""


def measure(trajectory: Trajectory, dt: float, following: bool) -> dict[str, np.ndarray]:
    """Return one number per episode and arm.

    Args:
        dt: time of a step, s.
        following: whether the goal moves, so that every step counts for `error`, `held` and `time`.

    Returns:
        [E, A] each, in m: `error` at the last step (following: root mean square over the steps); `held`, the largest of
        the last `HOLD` seconds (of all steps); `squared` (mean over the steps, m^2); least `distance`, largest
        `center`, `path` of the tip. Also `collided`; `time` from which on it is not `missed`, s, `smoothness`, and
        `action_change`, the root mean square in steps that begin at the goal, NaN where undefined; the mean of each of
        the `terms`, over the steps that count of those in `VIEWED`, NaN if there are none; at the last step of those in
        `LAST` and `BITES`, over all steps together of `TRAVEL`, the largest of `PEAK`.
    """
    lengths, error = trajectory.lengths[:, None], trajectory.error
    step = np.arange(1, len(error) + 1)[:, None, None]
    going = step <= lengths
    squared = np.where(going, np.square(error), 0.0).sum(0) / lengths
    judged = going if following else going & (step > lengths - max(1, round(HOLD / dt)))
    held = _largest(error, judged)
    last_miss = np.maximum(_largest(step, going & trajectory.missed), 0)

    def final(values: np.ndarray) -> np.ndarray:
        return np.take_along_axis(values, lengths[None] - 1, 0)[0]

    moves = np.linalg.norm(np.diff(trajectory.tip, axis=0), axis=-1)
    moves = np.where(going[1:], moves, 0.0)
    settled = going[1:] & ~trajectory.missed[:-1]
    with np.errstate(invalid="ignore"):
        change = np.sqrt(np.where(settled, trajectory.changes[1:], 0.0).sum(0) / settled.sum(0))
    shown = going & (trajectory.terms[SEARCHING] == 0) if SEARCHING in trajectory.terms else going
    return {
        "error": np.sqrt(squared) if following else final(error),
        "held": held,
        "squared": squared,
        "distance": -_largest(-trajectory.distance, going),
        "center": np.where(np.isnan(trajectory.center[0]), np.nan, _largest(trajectory.center, going)),
        "success": final(trajectory.success),
        "collided": (trajectory.collision & going).any(0),
        "time": np.where((trajectory.missed & judged).any(0) | following, np.nan, dt * (last_miss + 1)),
        "path": moves.sum(0),
        "smoothness": _smoothness(moves / dt, trajectory.lengths - 1, dt),
        "action_change": change,
        **{
            name: _reduced(name, values, shown if name in VIEWED else going, final)
            for name, values in trajectory.terms.items()
        },
    }


def courses(trajectory: Trajectory, max_steps: int) -> dict[str, np.ndarray]:
    """Return the course of each of `COURSES` that an episode of up to `max_steps` steps has, [points, E].

    A point is the largest value of an equal share of `max_steps`, so that none is passed over; NaN after the end.
    """
    points = min(POINTS, max_steps)
    steps = np.arange(len(trajectory.error))
    going = steps[:, None] < trajectory.lengths
    found = {}
    for name in COURSES:
        if name in trajectory.terms:
            course = np.full((points, len(trajectory.lengths)), np.nan)
            values = np.where(going, trajectory.terms[name][..., 0], np.nan)
            np.fmax.at(course, steps * points // max_steps, values)
            found[name] = course
    return found


def _reduced(name: str, values: np.ndarray, where: np.ndarray, final: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """Reduce steps to one number: their mean, unless the name asks for something else.

    That is whether a stage was ever reached or there was a drop, the largest of `PEAK`, the last of `LAST` and `BITES`,
    or the sum of `TRAVEL`.

    Args:
        where: [T, E, 1], the steps that count.
        final: returns the values at the last steps.
    """
    if name in LAST | BITES:
        return final(values)
    kept = np.where(where, values, 0.0)
    if name in TRAVEL:
        return kept.sum(0)
    with np.errstate(invalid="ignore"):
        return kept.max(0) if name.startswith((STAGE, DROP, *PEAK)) else kept.sum(0) / where.sum(0)


def metrics(measures: Mapping[str, np.ndarray], following: bool) -> dict[str, Metric]:
    """Return the metrics that `surgical-marl eval` reports, from the measures of R runs, [R, E, A] each.

    `following` adds the root mean square error of tasks whose goal moves.
    """
    mm = {name: 1000 * measures[name] for name in ("error", "held", "distance", "center", "path")}
    found = {
        "median_error_mm": Metric(mm["error"], _median),
        "mean_error_mm": Metric(mm["error"], _mean),
        "p95_error_mm": Metric(mm["error"], _percentile_95),
    }
    for threshold in THRESHOLDS_MM:
        found[f"success_{threshold}mm"] = success(mm["held"], threshold)
    found |= {
        f"team_success_{SUCCESS_MM}mm": success(mm["held"].max(-1, keepdims=True), SUCCESS_MM),
        "success_rate": Metric(measures["success"].astype(float), _mean, share=True),
        "collision_rate": Metric(measures["collided"].any(-1, keepdims=True).astype(float), _mean, share=True),
        "time_to_success_s": Metric(measures["time"], mean_of_known),
        "path_length_mm": Metric(mm["path"], _mean),
        "smoothness": Metric(measures["smoothness"], mean_of_known),
        "action_change": Metric(measures["action_change"], mean_of_known),
        "min_distance_mm": Metric(mm["distance"], lambda values: values.min(-1), extreme=True),
        "remote_center_error_mm": Metric(mm["center"], lambda values: np.fmax.reduce(values, -1), extreme=True),
    }
    if following:
        found["rmse_mm"] = Metric(1e6 * measures["squared"], lambda values: np.sqrt(values.mean(-1)))
    if DROP in measures:
        found["drop_rate"] = Metric(measures[DROP].max(-1, keepdims=True), _mean, share=True)
    for name, (title, unit) in (LAST | VIEWED | TRAVEL | PEAK).items():
        if name in measures:
            found[title] = Metric(unit * measures[name], mean_of_known, share=title.endswith("_rate"))
    found |= {title: Metric(unit * measures[n], _median) for n, (title, unit) in BITES.items() if n in measures}
    return found | {
        name: Metric(values, mean_of_known, share=name.startswith(SHARES))
        for name, values in measures.items()
        if name.startswith((*TERMS, STAGE))
    }


def success(held: np.ndarray, threshold: float) -> Metric:
    """Return the share of arms whose held error [R, E, A] is below a threshold of the same unit.

    Where the held error is NaN, so is the value of that arm.
    """
    return Metric(np.where(np.isnan(held), np.nan, held < threshold), _mean, share=True)


def spectral_arc_length(speed: np.ndarray, dt: float) -> float:
    """Return the smoothness of a movement: minus the arc length of its speed's normalised spectrum, at most 0.

    A movement in one even stroke has about -1.4; each further stroke, stop or tremor makes it more negative. This is
    SPARC of Balasubramanian et al., J. NeuroEngineering Rehabil. 12:112 (2015), with its published parameters: the
    spectrum up to 10 Hz, cut off where the amplitude stays below 5 % of that at 0 Hz, and padded by a factor of 16.

    Args:
        speed: [n], in any unit, not all zero.
        dt: time between samples, s.
    """
    size = 2 ** (math.ceil(math.log2(len(speed))) + 4)
    amplitude = np.abs(np.fft.rfft(speed, size))
    frequency = np.fft.rfftfreq(size, dt)
    amplitude = amplitude[frequency <= 10.0] / amplitude.max()
    last = int(np.flatnonzero(amplitude >= 0.05)[-1])
    if last == 0:
        return 0.0
    return -float(np.hypot(1 / last, np.diff(amplitude[: last + 1])).sum())


def _smoothness(speeds: np.ndarray, lengths: np.ndarray, dt: float) -> np.ndarray:
    """Return [E, A] of the first `lengths` speeds [T, E, A] (m/s) of each episode; NaN for a tip that hardly moved."""
    found = np.full(speeds.shape[1:], np.nan)
    for episode, arm in np.argwhere(speeds.sum(0) * dt >= STILL):
        found[episode, arm] = spectral_arc_length(speeds[: lengths[episode], episode, arm], dt)
    return found


def _largest(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    return np.where(where, values, -np.inf).max(0)


def _mean(values: np.ndarray) -> np.ndarray:
    return values.mean(-1)


def _median(values: np.ndarray) -> np.ndarray:
    return np.median(values, -1)


def _percentile_95(values: np.ndarray) -> np.ndarray:
    return np.percentile(values, 95, axis=-1)


def mean_of_known(values: np.ndarray) -> np.ndarray:
    """Return the mean of the known values; NaN if there are none."""
    known = ~np.isnan(values)
    with np.errstate(invalid="ignore"):
        return np.where(known, values, 0.0).sum(-1) / known.sum(-1)
