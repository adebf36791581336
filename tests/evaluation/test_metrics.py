"""Metrics and intervals against plain loops, known properties and known distributions."""

from __future__ import annotations

import cmath
import itertools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import binomtest

from surgical_marl.evaluation.interval import interval, over_seeds
from surgical_marl.evaluation.metrics import HOLD, Metric, Trajectory, courses, measure, metrics, spectral_arc_length

DT = 0.04  # success is judged over five steps


def random_trajectory(seed: int, lengths: list[int], arms: int) -> Trajectory:
    """Errors around the thresholds; whatever comes after an episode's end is as wild as the rest."""
    rng = np.random.default_rng(seed)
    shape = (max(lengths), len(lengths), arms)
    center = rng.random(shape)
    center[..., 0] = np.nan  # an arm without a remote center
    error = 10 ** rng.uniform(-4, -2.3, shape)
    return Trajectory(
        lengths=np.array(lengths),
        error=error,
        success=rng.random(shape) < 0.5,
        missed=error >= 0.002,
        collision=rng.random(shape) < 0.05,
        distance=rng.normal(0.05, 0.05, shape),
        changes=rng.random(shape),
        tip=rng.normal(0.0, 0.01, (*shape, 3)),
        center=center,
        terms={"cost": rng.random(shape)},
    )


def expected(trajectory: Trajectory, episode: int, arm: int, following: bool) -> dict[str, float]:
    """One episode of one arm, measured step by step."""
    count = int(trajectory.lengths[episode])
    error = [float(trajectory.error[step, episode, arm]) for step in range(count)]
    tip = [trajectory.tip[step, episode, arm] for step in range(count)]
    squared = math.fsum(value**2 for value in error) / count
    held = max(error if following else error[-round(HOLD / DT) :])
    first_good = count
    while first_good > 0 and error[first_good - 1] < 0.002:
        first_good -= 1
    speed = [math.dist(a, b) / DT for a, b in itertools.pairwise(tip)]
    changes = [float(trajectory.changes[n, episode, arm]) for n in range(1, count) if error[n - 1] < 0.002]
    return {
        "error": math.sqrt(squared) if following else error[-1],
        "held": held,
        "squared": squared,
        "distance": min(trajectory.distance[:count, episode, arm]),
        "center": max(trajectory.center[:count, episode, arm]),
        "collided": any(trajectory.collision[:count, episode, arm]),
        "time": DT * (first_good + 1) if held < 0.002 and not following else math.nan,
        "path": DT * math.fsum(speed),
        "cost": math.fsum(trajectory.terms["cost"][:count, episode, arm]) / count,
        "smoothness": arc_length(speed) if DT * math.fsum(speed) >= 0.001 else math.nan,
        "action_change": math.sqrt(math.fsum(changes) / len(changes)) if changes else math.nan,
    }


def arc_length(speed: list[float], dt: float = DT) -> float:
    """The spectral arc length from its definition: a Fourier sum at each frequency, then the way along the curve."""
    size = 16 * 2 ** math.ceil(math.log2(len(speed)))
    highest = min(10.0, 0.5 / dt)
    frequencies = [k / (size * dt) for k in range(size) if k / (size * dt) <= highest]
    spectrum = [abs(sum(v * cmath.exp(-2j * math.pi * f * dt * n) for n, v in enumerate(speed))) for f in frequencies]
    spectrum = [value / sum(speed) for value in spectrum]  # of a speed, the sum at 0 Hz is the largest
    cut = max(i for i, value in enumerate(spectrum) if value >= 0.05)
    points = [(f / frequencies[cut], value) for f, value in zip(frequencies, spectrum, strict=True)][: cut + 1]
    return -math.fsum(math.dist(a, b) for a, b in itertools.pairwise(points))


@settings(deadline=None, max_examples=25)
@given(
    st.integers(0, 2**32 - 1), st.lists(st.integers(2, 24), min_size=1, max_size=4), st.integers(1, 3), st.booleans()
)
def test_measures_equal_plain_loops(seed: int, lengths: list[int], arms: int, following: bool) -> None:
    trajectory = random_trajectory(seed, lengths, arms)
    found = measure(trajectory, DT, following)
    for episode in range(len(lengths)):
        for arm in range(arms):
            for name, value in expected(trajectory, episode, arm, following).items():
                assert found[name][episode, arm] == pytest.approx(value, rel=1e-9, nan_ok=True), name


@pytest.mark.parametrize("max_steps", [7, 100, 250])
def test_a_course_has_the_largest_of_each_share_of_the_time(max_steps: int) -> None:
    rng, lengths = np.random.default_rng(0), [7, 3]
    force = rng.random((7, 2, 1)).repeat(2, 2)
    trajectory = random_trajectory(0, lengths, 2)._replace(terms={"tissue_force": force, "cost": force})
    found, points = courses(trajectory, max_steps), min(100, max_steps)
    assert found.keys() == {"tissue_force"} and found["tissue_force"].shape == (points, 2)
    for episode, length in enumerate(lengths):
        for point in range(points):
            seen = [force[t, episode, 0] for t in range(length) if t * points // max_steps == point]
            assert found["tissue_force"][point, episode] == pytest.approx(max(seen, default=math.nan), nan_ok=True)


def test_an_object_is_dropped_once_and_at_its_goal_from_when_it_stays() -> None:
    """Two arms of a team and three episodes: it stays there from step 3 on, it leaves at the end, it is dropped."""
    steps, lengths = 10, np.array([10, 10, 4])
    missed = np.ones((steps, 3, 2), bool)
    missed[3:, 0], missed[2:9, 1] = False, False
    drop = np.zeros((steps, 3, 2))
    drop[3, 2] = 1.0
    drop[8, 2] = 1.0  # after its end
    plain = random_trajectory(0, lengths.tolist(), 2)
    found = measure(plain._replace(lengths=lengths, missed=missed, terms={"drop": drop}), DT, False)
    np.testing.assert_allclose(found["time"][0], 4 * DT)
    assert np.isnan(found["time"][1:]).all()
    assert found["drop"].tolist() == [[0, 0], [0, 0], [1, 1]]
    rates = metrics({name: value[None] for name, value in found.items()}, False)
    assert rates["drop_rate"].reduce(rates["drop_rate"].values.ravel()) == pytest.approx(1 / 3)


def test_the_score_of_a_trial_is_that_of_its_last_step() -> None:
    lengths = [3, 5]
    played = random_trajectory(0, lengths, 2)
    points = np.array([[0, 1], [1, 1], [1, 2], [9, 2], [9, 3]], float)[..., None].repeat(2, -1)
    told = {"score": points, "score_time": 10 * points}
    found = metrics(
        {name: values[None] for name, values in measure(played._replace(terms=told), DT, False).items()}, False
    )
    assert found["score"].values[0].tolist() == [[1, 1], [3, 3]]
    assert found["score_time_s"].values[0].tolist() == [[10, 10], [30, 30]]


def test_the_peak_force_is_the_largest_of_the_steps_of_an_episode() -> None:
    lengths = [3, 5]
    played = random_trajectory(0, lengths, 2)
    force = np.array([[0, 1], [4, 1], [2, 2], [9, 2], [9, 3]], float)[..., None] * [1.0, 10.0]
    found = metrics(
        {
            name: values[None]
            for name, values in measure(played._replace(terms={"contact_force": force}), DT, False).items()
        },
        False,
    )
    assert found["peak_force_n"].values[0].tolist() == [[4, 40], [3, 30]]


def test_what_an_episode_does_not_have_is_undefined() -> None:
    still = random_trajectory(0, [6, 1], 1)
    still.tip[...], still.error[...], still.distance[...], still.missed[...] = 0.01, 0.5, np.inf, True
    found = measure(still, DT, False)
    assert all(np.isnan(found[name]).all() for name in ("smoothness", "time", "action_change"))
    assert (found["path"] == 0).all() and (found["distance"] == np.inf).all()
    one_step = measure(random_trajectory(0, [1], 2), DT, False)
    assert (one_step["path"] == 0).all()


def test_what_is_reported_of_runs_is_reduced_as_documented() -> None:
    """Three runs of eleven episodes of two arms, each metric by a loop over what was measured; units and names too."""
    rng = np.random.default_rng(7)
    shape = (3, 11, 2)
    raw = {name: 10 ** rng.uniform(-4, -2, shape) for name in ("error", "held", "squared", "distance", "path")}
    raw |= {"success": rng.random(shape) < 0.5, "collided": rng.random(shape) < 0.2, "drop": np.zeros(shape)}
    raw |= {name: np.where(rng.random(shape) < 0.3, np.nan, rng.random(shape)) for name in
            ("center", "time", "smoothness", "action_change", "angle_error", "centre_error", "in_view",
             "camera_travel", "contact_force", "cost_force", "stage_lifted", "reward_lift", "other")}  # fmt: skip
    raw["drop"][:, :4, 0] = 1
    flat = {name: [float(value) for value in values.ravel()] for name, values in raw.items()}
    known = {name: [value for value in values if not math.isnan(value)] for name, values in flat.items()}
    teams = {name: [tuple(arms) for run in raw[name] for arms in run] for name in ("held", "collided", "drop")}
    mean, mm = (lambda values: math.fsum(values) / len(values)), 1000.0
    errors = sorted(mm * error for error in flat["error"])
    place = 0.95 * (len(errors) - 1)
    low = int(place)
    expected = {
        "median_error_mm": (errors[32] + errors[33]) / 2,
        "mean_error_mm": mean(errors),
        "p95_error_mm": errors[low] + (place - low) * (errors[low + 1] - errors[low]),
        **{f"success_{n}mm": mean([error < n / mm for error in flat["held"]]) for n in (1, 2, 5)},
        "team_success_2mm": mean([max(arms) < 0.002 for arms in teams["held"]]),
        "success_rate": mean(flat["success"]),
        "collision_rate": mean([max(arms) for arms in teams["collided"]]),
        "time_to_success_s": mean(known["time"]),
        "path_length_mm": mm * mean(flat["path"]),
        "smoothness": mean(known["smoothness"]),
        "action_change": mean(known["action_change"]),
        "min_distance_mm": mm * min(flat["distance"]),
        "remote_center_error_mm": mm * max(known["center"]),
        "drop_rate": mean([max(arms) for arms in teams["drop"]]),
        "angle_error_deg": math.degrees(1) * mean(known["angle_error"]),
        "centre_error": mean(known["centre_error"]),
        "in_view_rate": mean(known["in_view"]),
        "camera_travel_mm": mm * mean(known["camera_travel"]),
        "peak_force_n": mean(known["contact_force"]),
        **{name: mean(known[name]) for name in ("cost_force", "stage_lifted", "reward_lift")},
    }
    found = metrics(raw, following=False)
    assert {name: float(metric.reduce(metric.values.ravel())) for name, metric in found.items()} == pytest.approx(
        expected
    )
    assert {name for name, metric in found.items() if metric.extreme} == {"min_distance_mm", "remote_center_error_mm"}
    rows = [metric.reduce(metric.values.reshape(3, -1)) for metric in found.values()]  # as in a bootstrap
    for metric, row in zip(found.values(), rows, strict=True):
        np.testing.assert_allclose(row, [metric.reduce(metric.values[run].ravel()) for run in range(3)])
        assert metric.values.shape in ((3, 11, 2), (3, 11, 1))
    moving = metrics(raw, following=True)
    assert set(moving) - set(found) == {"rmse_mm"}
    rmse = moving["rmse_mm"]
    assert float(rmse.reduce(rmse.values.ravel())) == pytest.approx(mm * math.sqrt(mean(flat["squared"])))
    few = {name: values for name, values in raw.items() if name not in ("drop", "angle_error")}
    assert set(found) - set(metrics(few, following=False)) == {"drop_rate", "angle_error_deg"}


def test_terms_are_reduced_by_their_names_over_the_steps_that_count() -> None:
    lengths = [3, 5]
    played, rng = random_trajectory(0, lengths, 2), np.random.default_rng(1)
    drawn = {name: rng.random((5, 2, 2)) for name in ("cost", "in_view", "camera_travel", "angle_error", "reward_lift")}
    searching = (np.arange(5)[:, None, None] < [[1], [3]]) * np.ones((5, 2, 2))
    stages = np.zeros((5, 2, 2))
    stages[1, 0], stages[4, 0] = 1.0, 1.0  # reached and left again; after the end of the first episode
    found = measure(played._replace(terms={**drawn, "searching": searching, "stage_lifted": stages}), DT, False)
    plain = measure(played._replace(terms=drawn), DT, False)
    for episode, length in enumerate(lengths):
        own = {name: values[:length, episode] for name, values in drawn.items()}
        shown = own["in_view"][[1, 3][episode] :]
        for name, value in {
            "cost": own["cost"].mean(0), "reward_lift": own["reward_lift"].mean(0), "in_view": shown.mean(0),
            "camera_travel": own["camera_travel"].sum(0), "angle_error": own["angle_error"][-1],
            "stage_lifted": [1.0, 1.0] if episode == 0 else [0.0, 0.0],
        }.items():  # fmt: skip
            np.testing.assert_allclose(found[name][episode], value, err_msg=name)
        np.testing.assert_allclose(plain["in_view"][episode], own["in_view"].mean(0))
    never = measure(played._replace(terms={"in_view": drawn["in_view"], "searching": np.ones((5, 2, 2))}), DT, False)
    assert np.isnan(never["in_view"]).all()


def test_the_time_that_a_success_must_last_is_a_step_at_least() -> None:
    """Of steps that are longer than `HOLD` the last one is judged, and of shorter ones as many as `HOLD` has."""
    played = random_trajectory(0, [12], 1)
    played.error[:, 0, 0] = np.linspace(0.012, 0.001, 12)
    for dt, steps in ((1.0, 1), (0.5, 1), (0.1, 2), (0.05, 4)):
        assert measure(played, dt, False)["held"][0, 0] == pytest.approx(played.error[12 - steps, 0, 0])


def test_a_spectrum_of_one_or_two_frequencies_has_an_arc_too() -> None:
    """Of movements so short that 10 Hz is below their first frequency, or between that and the second one."""
    assert spectral_arc_length(np.array([1.0, 2.0]), 0.001) == 0.0
    found = spectral_arc_length(np.array([1.0, 2.0]), 1 / (32 * 7))
    assert found == pytest.approx(arc_length([1.0, 2.0], 1 / (32 * 7))) and found < -1
    assert spectral_arc_length(np.array([1.0]), 0.3) == pytest.approx(arc_length([1.0], 0.3))


def test_an_interval_needs_two_episodes_and_shrinks_with_its_confidence() -> None:
    found = interval(mean_of([[[0.0], [1.0]]]))
    assert found == [0.0, 1.0]


@settings(deadline=None, max_examples=25)
@given(
    st.lists(st.floats(0.0, 1.0), min_size=2, max_size=40).filter(lambda speed: max(speed) > 0.01),
    st.sampled_from([0.01, 0.02, 0.04, 0.1]),
    st.floats(1e-3, 1e3),
)
def test_spectral_arc_length(speed: list[float], dt: float, amplitude: float) -> None:
    found = spectral_arc_length(np.array(speed), dt)
    assert found == pytest.approx(arc_length(speed, dt), rel=1e-6)
    assert spectral_arc_length(amplitude * np.array(speed), dt) == pytest.approx(found, rel=1e-6)


def stroke(duration: float, dt: float = 0.002) -> np.ndarray:
    """The speed of the smoothest way from rest to rest, that of least jerk."""
    t = np.arange(0.0, duration, dt) / duration
    return t**2 * (1 - t) ** 2


def test_smoothness_tells_strokes_apart_and_nothing_else() -> None:
    one = spectral_arc_length(stroke(1.0), 0.002)
    assert one < 0
    for duration in (0.5, 2.0, 3.0):  # neither slow nor fast is smoother
        assert spectral_arc_length(stroke(duration), 0.002) == pytest.approx(one, rel=0.02)
    assert spectral_arc_length(stroke(1.0, 0.02), 0.02) == pytest.approx(one, rel=0.02)  # nor how often one looks
    waits = np.concatenate([stroke(1.0), np.zeros(1000)])
    assert spectral_arc_length(waits, 0.002) == pytest.approx(one, rel=0.02)  # nor holding still at the goal
    strokes = [spectral_arc_length(np.tile(stroke(1.0), n), 0.002) for n in (1, 2, 3, 4)]
    assert strokes == sorted(strokes, reverse=True) and strokes[1] < 1.2 * one
    tremor = stroke(1.0) * (1 + 0.5 * np.sin(2 * np.pi * 6 * np.arange(500) * 0.002))
    assert spectral_arc_length(tremor, 0.002) < 1.2 * one


def mean_of(values: Any) -> Metric:
    return Metric(np.asarray(values, float), lambda drawn: drawn.mean(-1))


def share_of(values: Any) -> Metric:
    return mean_of(values)._replace(share=True)


def bounds(metric: Metric) -> tuple[float, float]:
    found = interval(metric)
    assert found is not None
    return found[0], found[1]


@settings(deadline=None, max_examples=10)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(5, 60), st.integers(1, 3))
def test_an_interval_holds_the_value_and_repeats(seed: int, runs: int, episodes: int, arms: int) -> None:
    metric = mean_of(np.random.default_rng(seed).normal(size=(runs, episodes, arms)))
    low, high = bounds(metric)
    assert low <= metric.values.mean() <= high and low < high
    assert (low, high) == bounds(metric)


def test_an_interval_holds_the_truth_as_often_as_it_says() -> None:
    rng = np.random.default_rng(0)
    intervals = [bounds(mean_of(rng.exponential(size=(1, 80, 1)))) for _ in range(300)]
    covered = np.mean([low <= 1 <= high for low, high in intervals])
    assert 0.90 < covered < 0.98
    width = np.mean([high - low for low, high in intervals])
    assert width == pytest.approx(2 * 1.96 / math.sqrt(80), rel=0.1)  # the normal one, of a deviation of 1


def test_more_episodes_narrow_an_interval_and_arms_of_one_episode_do_not() -> None:
    values = np.random.default_rng(1).normal(size=(1, 400, 1))
    few, many = (np.ptp(bounds(mean_of(values[:, :count]))) for count in (25, 400))
    assert many == pytest.approx(few / 4, rel=0.35)
    assert bounds(mean_of(np.repeat(values, 3, -1))) == pytest.approx(bounds(mean_of(values)))


def test_the_spread_between_runs_counts() -> None:
    """Runs that differ by their seed alone: the interval is the t interval of their means, however many episodes."""
    rng = np.random.default_rng(2)
    offsets = np.array([-1.0, -0.3, 0.2, 0.4, 0.9])[:, None, None]
    few, many = (np.ptp(bounds(mean_of(offsets + 0.1 * rng.normal(size=(5, n, 1))))) for n in (50, 500))
    expected_width = 2 * 2.776 * offsets.std(ddof=1) / math.sqrt(5)  # t of 4 degrees of freedom
    assert few == pytest.approx(expected_width, rel=0.05) and many == pytest.approx(expected_width, rel=0.05)
    assert np.ptp(bounds(mean_of(0.1 * rng.normal(size=(1, 500, 1))))) < many / 20


@pytest.mark.parametrize("episodes", [2, 10, 200, 1000])
def test_the_interval_of_a_share_is_that_of_clopper_and_pearson(episodes: int) -> None:
    for hits in {0, 1, episodes // 2, episodes - 1, episodes}:
        values = (np.arange(episodes) < hits).astype(float)[None, :, None]
        exact = binomtest(hits, episodes).proportion_ci(0.95, "exact")
        expected = pytest.approx([exact.low, exact.high], abs=1e-9)
        assert bounds(share_of(values)) == expected
        assert bounds(share_of(np.repeat(values, 3, -1))) == expected  # arms of an episode are not independent


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(2, 60), st.integers(1, 3), st.floats(0.0, 1.0))
def test_an_interval_of_a_share_has_a_width(seed: int, runs: int, episodes: int, arms: int, chance: float) -> None:
    values = (np.random.default_rng(seed).random((runs, episodes, arms)) < chance).astype(float)
    low, high = bounds(share_of(values))
    assert 0 <= low <= values.mean() <= high <= 1
    assert high - low > 0.9 * (1 - 0.025 ** (1 / episodes))  # that of the narrowest, 0 or all of the episodes


def test_shares_of_steps_have_a_width_too_where_all_episodes_agree() -> None:
    """One that is 1 in all 200 episodes, one that is not; and a mean without spread, which has no interval."""
    steps = np.ones((1, 200, 1))
    assert bounds(share_of(steps)) == pytest.approx((0.98172, 1.0), abs=1e-5)
    steps[0, :20] = 0.5
    assert bounds(share_of(steps)) == bounds(mean_of(steps))
    assert interval(mean_of(np.full((1, 200, 1), 0.3))) is None and interval(mean_of(np.ones((3, 20, 2)))) is None


def test_three_seeds_hold_the_truth_as_often_as_they_say() -> None:
    """Seeds and goals that matter equally, and seeds that do not matter: few seeds must not look like many."""
    rng = np.random.default_rng(0)
    for spread in (0.0, 0.1):
        covered = []
        for _ in range(400):
            goals = rng.normal(size=100)
            seeds = spread * rng.normal(size=3)
            values = goals.mean() + seeds
            half = 1.96 * goals.std() / 10
            found = over_seeds(values, [[value - half, value + half] for value in values.tolist()])
            assert found is not None
            covered.append(found[0] <= 0 <= found[1])
        assert 0.91 < np.mean(covered) < 0.98


def test_an_interval_over_seeds_keeps_to_what_can_be() -> None:
    assert over_seeds([1.0, 1.0, 0.4], [[0.9, 1.0], [0.9, 1.0], [0.2, 0.6]], most=1.0) == [pytest.approx(0.0), 1.0]
    assert over_seeds([3.0, 0.1], [[2.0, 4.0], [0.0, 0.2]])[0] == 0.0  # type: ignore[index]
    assert over_seeds([-3.0, -0.1], [[-4.0, -2.0], [-0.2, 0.0]])[1] == 0.0  # type: ignore[index]
    assert over_seeds([2.0], [[1.0, 3.0]]) == [1.0, 3.0] and over_seeds([2.0, 2.0], [[1.0, 3.0], None]) is None


def test_no_interval_without_a_sample() -> None:
    assert interval(mean_of(np.ones((1, 1, 2)))) is None
    measures = measure(random_trajectory(3, [20] * 30, 1), DT, False)
    measures["time"] = np.where(np.arange(30)[:, None] == 7, 1.5, np.nan)  # one success: many resamples have none
    found = metrics({name: values[None] for name, values in measures.items()}, following=False)
    assert interval(found["time_to_success_s"]) is None
    assert found["time_to_success_s"].reduce(found["time_to_success_s"].values.ravel()) == 1.5
