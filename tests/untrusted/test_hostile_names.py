"""Names and texts of strangers stay texts: in the viewer's page, reports, notebooks and policies' cards."""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml

import surgical_marl as sm
from surgical_marl.content import find
from surgical_marl.evaluation.card import card
from surgical_marl.evaluation.report import Evaluation
from surgical_marl.report.page import render
from surgical_marl.report.run import read_run
from surgical_marl.runs.curve import draw_curve
from surgical_marl.runs.folder import CONFIG, CURVE
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.untrusted.markup import as_code, as_html, as_link, as_markdown, check_name
from surgical_marl.view.browser.panel import status
from surgical_marl.view.movers import Movers
from tests.helpers.run_folders import evaluate, make_run, played
from tests.report.test_report import Page

HOSTILE = {
    "script": "<script>alert(1)</script>",
    "attribute": "\"' onmouseover='alert(1)' x=\"",
    "closing": "--></td></table></style></title><img src=x onerror=alert(1)>",
    "link": "](javascript:alert(1)) [x](javascript:alert(2))",
    "picture": "![x](javascript:alert(1))",
    "autolink": "<javascript:alert(1)>",
    "reference": "[x]: javascript:alert(1)",
    "backticks": "a ``` b ` c `` <b>",
    "tick": "`",
    "lines": "a\n\n# b\n\n| c | d |\n|---|---|\n| e | f |\r\n```\n<script>\u2028x",
    "pipes": "a | b || c",
    "entity": "&lt;script&gt; &#x3c;b&#62;",
    "backslash": "\\<script>\\`x\\`",
    "stress": "*a* **b** _c_ ~~d~~ $e$",
    "template": "{{ 7 * 7 }} {% raw %} ${x} %s {0}",
    "emoji": "\U0001f52a\U0001f468\u200d\u2695\ufe0f \u202egnp.exe",
    "control": "a\x00b\x1b[31mc\x07",
    "no text": "a\udcffb",
    "long": "x" * 5000,
}
TAGS = {"script", "img", "style", "iframe", "b", "title"}
"""None of these is in what is looked at, but for hostile names."""
names = pytest.mark.parametrize("name", HOSTILE.values(), ids=HOSTILE.keys())


def as_one_line(text: str) -> str:
    """What is left of a text that a line shows."""
    text = "".join(letter if letter.isprintable() else " " for letter in text.encode(errors="replace").decode())
    return " ".join(text.split())


def rendered(text: str) -> Page:
    """Markdown as HTML, with tables and struck texts as GitHub has them, raw tags, and any kind of link."""
    parser = pytest.importorskip("markdown_it").MarkdownIt("commonmark", {"html": True})
    parser.validateLink = lambda _: True
    return Page(parser.enable(["table", "strikethrough"]).render(text))


@names
def test_a_text_in_html_is_only_text(name: str) -> None:
    page = Page(f"<p title=\"{as_html(name)}\" class='{as_html(name)}'>{as_html(name)}</p>")
    shown = name.encode(errors="replace").decode()
    assert page.text.replace("\r\n", "\n") == shown.replace("\r\n", "\n")
    assert page.elements == [("p", {"title": shown, "class": shown})]


@names
def test_a_text_in_markdown_is_only_text(name: str) -> None:
    page = rendered(f"Before {as_markdown(name)} after.\n\n| a | b |\n|---|---|\n| {as_markdown(name)} | c |\n")
    assert Counter(tag for tag, _ in page.elements) == Counter(["p", "table", "thead", *["tr", "th", "th"], "tbody",
                                                               *["tr", "td", "td"]])  # fmt: skip
    assert f"Before {as_one_line(name)} after." in page.text and page.text.count(as_one_line(name)) == 2


@names
def test_a_text_as_code_is_only_code(name: str) -> None:
    page = rendered(f"# {as_code(name)}\n\n| a | b |\n|---|---|\n| {as_code(name)} | c |\n")
    assert Counter(tag for tag, _ in page.elements if tag not in ("h1", "code")) == Counter(
        ["table", "thead", "tr", "th", "th", "tbody", "tr", "td", "td"]
    )
    assert page.text.split("\n")[0].replace("\\|", "|") == as_one_line(name)


@names
def test_a_link_leads_to_a_file_beside_the_page(name: str) -> None:
    page = rendered(as_link(name))
    assert [tag for tag, _ in page.elements] == ["p", "a"]
    assert re.fullmatch(r"[\w.%~-]+", page.of("a")[0]["href"] or "")


def test_what_is_harmless_is_written_as_it_is() -> None:
    for text in ("peg_transfer-bimanual_psm_pegs", "a PSM (Si), 26.5 mm; 95 %: good!", "2026-01-01T00:00:00+0000"):
        assert as_markdown(text) == text and as_code(text) == f"`{text}`"
    assert as_link("reach-psm") == "[reach-psm](reach-psm)"


@names
def test_the_viewers_text(name: str) -> None:
    infos = {name: {f"stage_{name}": [1.0], "tip_error": [0.001]}}
    env = SimpleNamespace(task_name=name, scene=SimpleNamespace(name=name), steps=[3], control_dt=0.1, max_steps=10,
                          agents=[name])  # fmt: skip
    session: Any = SimpleNamespace(env=env, settings=Settings(difficulty=name), seed=3, infos=infos)
    page = Page(status(session))
    assert {tag for tag, _ in page.elements} == {"div", "b", "br", "table", "tr", "td"}
    assert all(attributes.keys() <= {"style"} for _, attributes in page.elements)
    assert "1.00 mm" in page.text and len(page.text) < 3 * 200 + 2 * len(name) + 100


@names
def test_a_notebook(name: str, tmp_path: Path) -> None:
    """Names of agents, metrics and partners of an evaluation, of folders of runs, and of videos."""
    one = {"intervals": {f"reward_{name}": None}, f"reward_{name}": 1.0}
    about = dict.fromkeys(("task", "scene", "difficulty", "control", "goals", "start", "goal_set", "seed"), name)
    result = Evaluation({**about, **one, "episodes": 3, "agents": {name: one}, "partners": {name: name}})
    page = Page(result._repr_html_())
    assert not {tag for tag, _ in page.elements} - {"table", "caption", "thead", "tbody", "tr", "th", "td"}
    assert not any(attributes for _, attributes in page.elements)
    result._repr_html_().encode()
    if "/" in name or "\0" in name or len(name) > 255:
        return
    run = evaluate(make_run(tmp_path / name))
    shutil.copyfile(run / "video.mp4", video := tmp_path / f"{name}.mp4")
    for made in (sm.Report(run), sm.Video(video)):
        text = made._repr_html_()
        text.encode()  # a notebook is a file in UTF-8
        (element,) = Page(text).elements
        assert element[0] in ("iframe", "video") and not any(key.startswith("on") for key in element[1])
        if isinstance(made, sm.Report):
            inside = Page(element[1]["srcdoc"] or "")
            assert element[1]["srcdoc"] == made.html and not {tag for tag, _ in inside.elements} & {"script", "img"}


@pytest.mark.parametrize("key", ["script", "closing", "long", "no text", "template", "control"])
def test_a_report(key: str, tmp_path: Path) -> None:
    """Names within a run's files; tests/report/test_report.py has those of its folder."""
    name = HOSTILE[key]
    run = make_run(tmp_path / "run")
    plain = name.encode(errors="replace").decode()
    values = yaml.safe_load((run / CONFIG).read_text()) | {"algo": plain, "scene": plain}
    (run / CONFIG).write_text(yaml.safe_dump(values))
    evaluate(run, played((name, "b"), stages=(plain, "c")))
    text = render([read_run(run)])
    page = Page(text)
    text.encode()
    assert not {tag for tag, _ in page.elements} & {"script", "img", "iframe"}
    assert not [name for _, attributes in page.elements for name in attributes if name.startswith("on")]
    assert f"reach in {plain}".replace("\0", "\ufffd") in page.text.replace("\0", "\ufffd")


@names
def test_a_card(name: str, tmp_path: Path) -> None:
    """Markdown of a policy whose files come from a stranger: the same elements as without the hostile texts."""

    def elements(text: str) -> Page:
        plain = text.encode(errors="replace").decode()
        folder = tmp_path / str(len(list(tmp_path.iterdir())))
        shutil.copytree(find("policies", "reach-psm"), folder)
        scene = yaml.safe_load(find("scenes", "psm").read_text()) | {"description": plain}
        (folder / "psm.yaml").write_text(yaml.safe_dump(scene))
        config = yaml.safe_load((folder / CONFIG).read_text()) | {"scene": str(folder / "psm.yaml")}
        config["versions"] = {"python": plain, "torch": plain}
        config["origin"] = {"device": plain, "commit": plain, "started": plain}
        (folder / CONFIG).write_text(yaml.safe_dump(config))
        found = json.loads((folder / "evaluation.json").read_text()) | {"goal_set": text, "protocol": text}
        found["also"] = {text: next(iter(found["also"].values()))}
        found["seeds"]["best"] = text
        for run in found["seeds"]["runs"]:
            run["policy"] = text
        (folder / "evaluation.json").write_text(json.dumps(found))
        written = card(folder, text)
        written.encode()
        return rendered(written)

    page, harmless = elements(name), elements("harmless")
    assert [tag for tag, _ in page.elements] == [tag for tag, _ in harmless.elements]
    links = [[each["href"] for each in one.of("a")] for one in (page, harmless)]
    assert links[0] == links[1] and not any("javascript" in (link or "") for link in links[0])
    assert page.text.count(as_one_line(name)) >= 6


def test_a_command_in_a_card_is_one_command(tmp_path: Path) -> None:
    folder = shutil.copytree(find("policies", "reach-psm"), tmp_path / "policy")
    shutil.copyfile(find("scenes", "psm"), scene := tmp_path / "x; touch owned.yaml")
    config = yaml.safe_load((folder / CONFIG).read_text()) | {"scene": str(scene)}
    (folder / CONFIG).write_text(yaml.safe_dump(config))
    text = card(folder, "$(touch owned)")
    assert f"surgical-marl train reach --scene '{scene}' --start" in text
    assert "surgical-marl eval '$(touch owned)'" in text


@pytest.mark.parametrize("key", ["lines", "control", "no text"])
def test_names_that_nothing_can_show_are_refused(key: str, tmp_path: Path) -> None:
    name = HOSTILE[key].replace("\0", "").replace("/", "")
    for kind, load in (("scenes", load_scene), ("objects", load_object)):
        path = tmp_path / f"{name}.yaml"
        shutil.copyfile(find(kind, {"scenes": "psm", "objects": "pad"}[kind]), path)
        with pytest.raises(ValueError, match="which can't be shown: give it another one") as caught:
            load(path)
        assert str(caught.value).isprintable()
    shutil.copytree(find("arms", "psm"), tmp_path / name)
    with pytest.raises(ValueError, match=r"the name of an arm's folder, .* can't be shown"):
        sm.load_arm(tmp_path / name)


def test_names_in_any_script_are_good() -> None:
    for name in ("näht", "針", "игла 2", "a\u3000b", HOSTILE["emoji"], "a'b\"c`d"):
        check_name(name, "a scene")


def test_a_run_that_no_menu_can_show_moves_nothing(tmp_path: Path) -> None:
    run = shutil.copytree(find("policies", "reach-psm"), tmp_path / "a\nb")
    env = SimpleNamespace(agents=["psm_0"])
    with pytest.raises(ValueError, match=r"the name of a run, .* can't be shown"):
        Movers(env, os.fspath(run))  # type: ignore[arg-type]


@pytest.mark.parametrize("title", ["$\\frac{", "a$b$c^{", HOSTILE["no text"], HOSTILE["lines"], HOSTILE["long"]])
def test_a_curve_of_any_name(title: str, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    draw_curve(run, title)
    assert (run / CURVE).stat().st_size > 1000
