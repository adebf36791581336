"""Finding arms, scenes, configs and policies by name and by path."""

from __future__ import annotations

from pathlib import Path

import pytest

from surgical_marl import content
from surgical_marl.plugins.tasks import list_tasks


def test_lists_name_what_lies_in_the_folders() -> None:
    assert "psm" in content.list_arms()
    assert {"psm", "bimanual_psm"} <= set(content.list_scenes())
    assert "reach" in list_tasks()
    for kind in content.KINDS:
        assert content.content_dir(kind).is_dir(), kind


@pytest.mark.parametrize("kind, name", [("arms", "psm"), ("scenes", "psm"), ("configs", "reach")])
def test_a_shipped_name_is_found(kind: str, name: str) -> None:
    path = content.find(kind, name)
    assert path.stem == name and path.parent == content.content_dir(kind)


def test_a_path_of_ones_own_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "mine.yaml").write_text("")
    (tmp_path / "my_arm").mkdir()
    monkeypatch.chdir(tmp_path)
    assert content.find("scenes", "./mine.yaml") == tmp_path / "mine.yaml"
    assert content.find("scenes", tmp_path / "mine.yaml") == tmp_path / "mine.yaml"
    assert content.find("arms", "my_arm") == tmp_path / "my_arm"


def test_a_shipped_name_goes_before_a_folder_of_that_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "psm").mkdir()
    monkeypatch.chdir(tmp_path)
    assert content.find("arms", "psm") == content.content_dir("arms") / "psm"


@pytest.mark.parametrize(
    "kind, value, words",
    [
        ("scenes", "bimanual_pms", ["'bimanual_pms'", "did you mean 'bimanual_psm'", "psm"]),
        ("scenes", "./missing.yaml", ["'./missing.yaml', and no such file", "psm"]),
        ("arms", "psn", ["unknown arm 'psn'", "did you mean 'psm'"]),
        ("policies", "", ["unknown run or policy ''"]),
        ("scenes", ".", ["unknown scene '.'"]),
        ("scene", "psm", ["unknown kind of content 'scene'", "did you mean 'scenes'"]),
    ],
)
def test_what_is_not_there_is_named(kind: str, value: str, words: list[str]) -> None:
    with pytest.raises(ValueError) as raised:
        content.find(kind, value)
    for word in words:
        assert word in str(raised.value)


def test_content_in_a_wheel_goes_before_folders_beside_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "site-packages" / "surgical_marl"
    (package / "content" / "configs").mkdir(parents=True)
    (package.parent / "configs").mkdir()  # another distribution's
    monkeypatch.setattr(content, "_PACKAGE", package)
    assert content.content_dir("configs") == package / "content" / "configs"
    assert content.list_policies() == []
