"""The gallery: it shows all content, and what it links to is there."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

import surgical_marl as sm
from docs.studies import gallery
from tests.helpers import ROOT

DOCS = ROOT / "docs"


def test_the_page_shows_all_content_and_its_pictures_exist() -> None:
    text = (DOCS / "gallery.md").read_text()
    for name in (*sm.list_arms(), *sm.list_objects(), *sm.list_scenes(), *sm.list_tasks()):
        assert f"`{name}`" in text
    links = re.findall(r"!\[\]\((.*?)\)", text)
    assert links and all((DOCS / link).is_file() for link in links)
    pictures = [
        *(DOCS / "images").rglob("*.webp"),
        *(sm.load_arm(name).folder / "preview.png" for name in sm.list_arms()),
    ]
    sizes = [path.stat().st_size for path in pictures]
    assert max(sizes) < 2e6 and sum(sizes) < 6e6
    captions = dict(re.findall(r"images/tasks/(\w+)\.webp\)<br>(.*?) \|", text))
    assert gallery.page(captions) == text


def test_a_task_is_played_by_its_policy_or_by_the_oracle(monkeypatch: pytest.MonkeyPatch) -> None:
    assert gallery.player("reach") == ("reach-trimanual_psm_ecm", "trimanual_psm_ecm")
    assert gallery.player("peg_transfer") == ("peg_transfer-trimanual_psm_ecm_pegs", "trimanual_psm_ecm_pegs")
    monkeypatch.setattr(gallery, "list_policies", lambda: ["reach-psm"])
    assert gallery.player("reach") == ("reach-psm", "psm")
    assert gallery.player("camera_assist") == ("oracle", "trimanual_psm_ecm")


def test_objects_stand_on_the_ground_in_the_middle_of_their_picture() -> None:
    drawn = gallery.object_picture("ring").astype(int)
    green = drawn[..., 1] > 1.3 * drawn[..., 0]
    rows, columns = np.argwhere(green).T
    width, height = gallery.SMALL
    assert rows.min() > 0 and rows.max() < height - 1 and columns.min() > 0 and columns.max() < width - 1
    assert abs(columns.mean() - width / 2) < 0.05 * width


def test_names_that_do_not_exist_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"nothing is called psn: there are .*psm"):
        gallery.main(["--results", str(tmp_path), "--only", "psn"])
