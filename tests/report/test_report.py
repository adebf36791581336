"""The page of a report: what it says, that it needs nothing else, and that no text of a run becomes markup."""

from __future__ import annotations

import html
import itertools
import json
import re
from collections import Counter
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
import yaml

import surgical_marl as sm
from surgical_marl.evaluation.command import FILM, RESULT
from surgical_marl.evaluation.evaluate import EPISODES, read_played, write_played
from surgical_marl.evaluation.report import Evaluation
from surgical_marl.report import evaluation, page, training
from surgical_marl.report.charts import SHARE, Drawing, Text
from surgical_marl.report.groups import curve, differences, group
from surgical_marl.report.page import render
from surgical_marl.report.run import read_run
from surgical_marl.runs.folder import CHECKPOINT, CONFIG, DIVERGED, METRICS
from tests.helpers.run_folders import evaluate, make_run, played

LOADS = ("src", "href", "xlink:href", "srcset", "data", "action", "poster", "background", "srcdoc")
HOSTILE = "<img src=x onerror=alert(1)>"
SCRIPT = "\"'></title></style><script>alert(2)</script>"


class Page(HTMLParser):
    """A page's elements, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        self.text += data

    def of(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.elements if name == tag]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Page:
    """The report of two seeds of one setting and one of another, all evaluated."""
    root = tmp_path_factory.mktemp("runs")
    runs = [evaluate(make_run(root / f"s{seed}", seed=seed)) for seed in (0, 1)]
    runs.append(evaluate(make_run(root / "other", num_envs=128)))
    return Page(render([read_run(run) for run in runs]))


def test_a_page_loads_nothing(whole: Page) -> None:
    found = [value or "" for _, attributes in whole.elements for name, value in attributes.items() if name in LOADS]
    assert found and all(value.startswith(("#", "data:video/mp4;base64,")) for value in found)
    (policy,) = [each["content"] for each in whole.of("meta") if each.get("http-equiv") == "Content-Security-Policy"]
    assert policy and policy.startswith("default-src 'none';") and "http" not in policy and "script" not in policy
    assert not {tag for tag, _ in whole.elements} & {"script", "link", "iframe", "object", "embed", "base", "form"}
    styles = [value for _, attributes in whole.elements if (value := attributes.get("style"))] + [whole.text]
    assert not [style for style in styles if re.search(r"@import|url\((?!#)|https?:", style)]


def test_charts_can_be_followed_without_seeing_them(whole: Page) -> None:
    ids = Counter(attributes["id"] for _, attributes in whole.elements if "id" in attributes)
    assert set(ids.values()) == {1}
    charts = whole.of("svg")
    assert len(charts) > 10
    for chart in charts:
        assert chart["role"] == "img" and all(name in ids for name in (chart["aria-labelledby"] or "").split())
    names = [tag for tag, _ in whole.elements]
    assert names.count("desc") == len(charts) and names.count("figcaption") >= len(charts)
    assert names.count("caption") == names.count("table") >= len(charts)
    links = {each["href"] for each in whole.of("a")}
    assert links and all((link or "")[1:] in ids for link in links)


def test_a_page_says_what_was_trained_and_how_to_repeat_it(whole: Page) -> None:
    for words in ("reach in psm", "every arm brings", "a GPU", "0123456789ab", "git checkout 0123456789ab", "2.12.0",
                  "surgical-marl train reach --scene psm --seed 1", "num_envs=64", "num_envs=128", "Always zero: idle",
                  "Success against threshold", "Peak contact force (N)", "Least distance"):  # fmt: skip
        assert words in whole.text, words


def test_texts_of_a_run_stay_texts(tmp_path: Path) -> None:
    run = make_run(tmp_path / HOSTILE)
    values = yaml.safe_load((run / CONFIG).read_text())
    values |= {"scene": SCRIPT, "algo": SCRIPT, "network": {HOSTILE: SCRIPT}, "versions": {SCRIPT: HOSTILE}}
    values["origin"] = {"device": HOSTILE, "commit": "$(touch owned)", "started": SCRIPT}
    (run / CONFIG).write_text(yaml.safe_dump(values))
    (run / METRICS).write_text(
        (run / METRICS).read_text().replace("entropy", "</svg><script>").replace("idle", HOSTILE)
    )
    evaluate(run, played((HOSTILE, "$x_{"), stages=("<b>", "$\\frac{", "a\x01b")))
    found = Page(render([read_run(run)]))
    tags = {tag for tag, _ in found.elements}
    assert not tags & {"script", "img", "b>"} and not [a for _, a in found.elements if "onerror" in a]
    assert HOSTILE in found.text and SCRIPT in found.text and "$\\frac{" in found.text
    assert "git checkout '$(touch owned)'" in found.text


def test_runs_that_differ_by_their_seed_are_one_group_with_a_band(tmp_path: Path) -> None:
    first, second = make_run(tmp_path / "a", success=0.2), make_run(tmp_path / "b", success=0.6, seed=1, rows=4)
    other = make_run(tmp_path / "c", num_envs=8)
    groups = group([read_run(run) for run in (first, other, second)])
    assert [[run.name for run in each.runs] for each in groups] == [["a", "b"], ["c"]]
    assert differences(groups) == {"num_envs": [64, 8]}
    found = curve(groups[0], "success_rate")
    assert found is not None and found.x[-1] == 4000 and found.single[0][0][-1] == 6000
    np.testing.assert_allclose([found.mean, found.low, found.high], np.outer([0.4, 0.2, 0.6], np.ones(len(found.x))))
    assert curve(groups[0], "no_such_column") is None


def test_the_parts_of_an_iteration_have_curves_where_they_are_known(tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    assert [chart.title for chart in training.speed(Drawing(), group([read_run(run)]))] == [
        "Environment steps a second"
    ]
    (run / METRICS).write_text((run / METRICS).read_text().replace("entropy", "seconds_rollout"))
    titles = [chart.title for chart in training.speed(Drawing(), group([read_run(run)]))]
    assert titles == ["Environment steps a second", "Seconds of an iteration", "Seconds rollout"]


def test_numbers_beside_charts_are_those_of_the_episodes(tmp_path: Path) -> None:
    episodes = played(("left", "right"), stages=("grasped",))
    run = read_run(evaluate(make_run(tmp_path / "run"), episodes))
    found = {chart.title: chart for chart in evaluation.charts(Drawing(), group([run]))}
    within = 1000 * episodes.measures["held"] < 2
    assert f"left: {np.mean(1000 * episodes.measures['held'][:, 0] < 1):.1%} within 1 mm" in (
        described := found["Success against threshold"].description
    )
    assert f"{within[:, 1].mean():.1%} within 2 mm" in described
    ((name, left, right),) = found["Stages of the task"].rows
    shares = episodes.measures["stage_grasped"].mean(0)
    assert name == "grasped" and left.startswith(f"{shares[0]:.1%} (") and right.startswith(f"{shares[1]:.1%} (")
    columns = np.array([[float(cell.rstrip("%")) for cell in row[1:]] for row in found["Error (mm)"].rows])
    np.testing.assert_allclose(columns.sum(0), 100, atol=0.6)


def test_a_histogram_is_not_ruled_by_one_outlier(tmp_path: Path) -> None:
    episodes = played(tuple(f"arm_{i}" for i in range(10)))
    episodes.measures["contact_force"][0, 0] = 1000.0
    found = evaluation.charts(Drawing(), group([read_run(evaluate(make_run(tmp_path / "run"), episodes))]))
    (chart,) = [chart for chart in found if chart.title == "Peak contact force (N)"]
    assert "arm_0: " in chart.description and "1e+03" in chart.description
    assert chart.rows[-1][0].endswith(" or more") and chart.rows[-1][1] != "0.0%" and chart.rows[0][1] != "0.0%"


def test_what_is_missing_is_said(tmp_path: Path) -> None:
    begun = read_run(make_run(tmp_path / "begun", rows=0))
    assert begun.status == "Unfinished: no iteration is done yet." and "no iteration" in Page(render([begun])).text
    stopped = read_run(make_run(tmp_path / "stopped", rows=3))
    assert "3 of 6 iterations" in stopped.status and "--evaluate" in stopped.notes[0]
    (stopped.folder / DIVERGED).write_text("{}")
    (stopped.folder / CHECKPOINT).unlink()
    diverged = read_run(stopped.folder)
    assert diverged.status.startswith("Diverged after 3 of 6") and f"no {CHECKPOINT}" in diverged.notes[0]
    older = read_run(evaluate(make_run(tmp_path / "older"), iteration=2))
    assert older.finished and any("iteration 2" in note for note in older.notes)


@pytest.mark.parametrize("damage", ["", "{", "[]", '{"task": 1}', '"median_error_mm": "<b>"', '"agents": 3'])
def test_a_damaged_evaluation_is_left_out(damage: str, tmp_path: Path) -> None:
    run = evaluate(make_run(tmp_path / "run", rows=0))
    text = (run / RESULT).read_text()
    if damage.startswith('"'):
        text = json.dumps({**json.loads(text), **json.loads(f"{{{damage}}}")})
    (run / RESULT).write_text(text if damage.startswith('"') else damage)
    found = read_run(run)
    assert found.result is None and "left out" in found.notes[0] and RESULT in found.notes[0]
    assert found.notes[0] in Page(render([found])).text


def test_force_and_tension_are_drawn_over_time(tmp_path: Path) -> None:
    """From the file of the episodes, in the unit that is said; a thread that was never pulled is left out."""
    course = np.where(np.arange(20) < np.arange(1, 11)[:, None] * 2, np.nan, 1.5)  # [points, E]: each ends at its time
    course[-1] = np.nan
    found = played()._replace(courses={"tissue_force": course, "tension": 0 * course})
    run = evaluate(make_run(tmp_path / "run"), found)
    again = read_played(run / EPISODES)
    np.testing.assert_array_equal(again.courses["tissue_force"], course)
    assert again.measures.keys() == found.measures.keys()
    page = Page(render([read_run(run)]))
    assert "Force on tissue over time (N)" in page.text and "Tension of thread" not in page.text
    assert re.search(r"0\.2\s*1\.5\s*1\.5\s*1\.5", page.text)
    write_played(run / EPISODES, found._replace(courses={"tissue_force": course[:, :3]}))
    assert "damaged" in read_run(run).notes[0]


def test_damaged_episodes_are_left_out(tmp_path: Path) -> None:
    run = evaluate(make_run(tmp_path / "run"))
    write_played(run / EPISODES, again := read_played(run / EPISODES))
    np.testing.assert_allclose(again.measures["error"], played().measures["error"], rtol=1e-6)
    assert read_run(run).played is not None
    (run / EPISODES).write_bytes((run / EPISODES).read_bytes()[:300])
    found = read_run(run)
    assert found.played is None and found.result is not None and "Histograms" in found.notes[0]


def test_a_large_clip_is_named_and_a_small_one_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (make_run(tmp_path / "run", rows=0) / FILM).write_bytes(b"small")
    run = read_run(tmp_path / "run")
    assert [video["src"] for video in Page(render([run])).of("video")] == ["data:video/mp4;base64,c21hbGw="]
    monkeypatch.setattr(page, "CLIP_LIMIT", 4)
    found = Page(render([run]))
    assert not found.of("video") and "video.mp4 in the run's folder" in found.text


def test_many_series_are_told_apart() -> None:
    one = np.ones((1, 8))
    text = Text("t", "d", ["h"], [["r"]], [(str(i), i) for i in range(8)])
    svg = str(Drawing().bars(text, ["label"], one, np.full((1, 8, 2), np.nan), SHARE).svg)
    assert {f"var(--s{i})" in svg for i in range(6)} == {True} and "var(--s6)" not in svg


def test_what_shows_itself_in_a_notebook(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    minutes = itertools.count()  # a page says when it was made: what is written is what was shown, not another page
    monkeypatch.setattr(page.time, "strftime", lambda *_: f"minute {next(minutes)}")
    run = evaluate(make_run(tmp_path / "run", rows=0), played((HOSTILE,)))
    report = sm.Report(run)
    (frame,) = Page(report._repr_html_()).of("iframe")
    assert frame["srcdoc"] == report.html and frame["sandbox"] == ""
    assert report.write(tmp_path / "page.html").read_text() == report.html
    (video,) = Page(sm.Video(run / "video.mp4")._repr_html_()).of("video")
    assert (video["src"] or "").startswith("data:video/mp4;base64,")
    with pytest.raises(ValueError, match="no video"):
        sm.Video(tmp_path / "none.mp4")
    shown = Evaluation(json.loads((run / RESULT).read_text()))._repr_html_()
    assert "<table>" in shown and html.escape(HOSTILE) in shown and not Page(shown).of("img")


def test_a_metric_without_a_unit_says_what_it_is() -> None:
    from surgical_marl.evaluation.report import explained

    assert explained("cost") == "cost (limits broken, mean of a step)"
    assert explained("cost_force") == "cost force (share of steps)"
    assert explained("reward_distance") == "reward distance (mean of a step)"
    assert explained("median_error_mm") == "median error (mm)"
