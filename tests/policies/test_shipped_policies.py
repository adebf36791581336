"""The policies in policies/: what is in their folders, and that their numbers come out again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest

from surgical_marl.content import content_dir, list_policies
from surgical_marl.evaluation.card import card, table
from surgical_marl.evaluation.command import play_all
from surgical_marl.evaluation.evaluate import summarise
from surgical_marl.evaluation.goal_set import is_standard
from surgical_marl.runs.folder import read_origin
from surgical_marl.untrusted.arrays import read_header

POLICIES = content_dir("policies")
MOVED_MM = 1e-3
"""How far the floats of another machine may move the error of an episode. For a policy of reach in bimanual_psm the
other engine moved it by 6e-5 mm at most, noise in the actions by 5e-5 mm (1e-6 of them) and 2e-3 mm (1e-4): arms
that come to rest at their goals forget how they came there."""
OTHERWISE = 1
"""Episodes of 200 that may go another way altogether: where arms touch, the last digit can decide on which side."""


def read(name: str) -> dict[str, Any]:
    result: dict[str, Any] = json.loads((POLICIES / name / "evaluation.json").read_text())
    return result


@pytest.mark.parametrize("name", list_policies())
def test_a_folder_is_whole(name: str) -> None:
    folder, result = POLICIES / name, read(name)
    for file in ("README.md", "config.yaml", "metrics.csv", "curve.png"):
        assert (folder / file).is_file()
    weights = {path.stem for path in folder.glob("*.safetensors")}
    assert weights and weights == {path.stem for path in folder.glob("*.onnx")}
    assert not [path for path in folder.iterdir() if path.suffix in (".pt", ".pkl", ".tmp")]
    for path in folder.glob("*.onnx"):  # weights are not stored twice, nor folders of the machine that wrote it
        assert path.stat().st_size < 20_000 and b"site-packages" not in path.read_bytes()
        assert not missing_weights(path)
    level = "" if result["difficulty"] == "default" else f"-{result['difficulty']}"
    assert name == f"{result['task']}-{result['scene']}{level}" and is_standard(result)
    page = (folder / "README.md").read_text()
    assert bool(level) == ("--difficulty" in page) and result["difficulty"] in page
    assert len(result["seeds"]["runs"]) >= 3
    assert all(read_origin(folder)["origin"].values())


def missing_weights(path: Path) -> set[str]:
    """Return the weights of a policy that its ONNX file does not read from where they stand in its safetensors."""
    tensors, begin = read_header(path.with_suffix(".safetensors"))
    places = {
        f"model.{name}": (place["shape"], begin + place["data_offsets"][0])
        for name, place in tensors.items()
        if name.endswith((".weight", ".bias"))
    }
    for tensor in onnx.load(path, load_external_data=False).graph.initializer:
        about = {entry.key: entry.value for entry in tensor.external_data}
        if about and (list(tensor.dims), int(about["offset"])) == places.get(tensor.name):
            del places[tensor.name]
    return set(places)


def test_all_of_them_are_small_and_in_the_table() -> None:
    assert sum(path.stat().st_size for path in POLICIES.rglob("*") if path.is_file()) < 60e6
    assert table() in (POLICIES / "README.md").read_text()


@pytest.mark.parametrize("name", list_policies())
def test_its_intervals_have_a_width_and_its_card_is_of_its_files(name: str) -> None:
    result = read(name)
    every = [result, *result["also"].values(), *result["seeds"]["runs"], result["seeds"]["aggregate"]]
    for part in [one for each in every for one in (each, *each["agents"].values())]:
        bounds = [(key, *pair) for key, pair in part["intervals"].items() if pair is not None]
        assert bounds and not [key for key, low, high in bounds if not low < high]
    assert card(POLICIES / name, name) == (POLICIES / name / "README.md").read_text()


@pytest.mark.parametrize("name", ["reach-psm", pytest.param("reach-bimanual_psm", marks=pytest.mark.slow)])
def test_its_numbers_come_out_again(name: str) -> None:
    if name not in list_policies():
        pytest.skip(f"{name} does not ship yet")
    published = read(name)
    (played,) = play_all([name], dict.fromkeys(("task", "scene", "control", "difficulty")), 200, 0).values()
    assert summarise([played])["goal_set"] == published["goal_set"]
    error, held = 1000 * played.measures["error"], 1000 * played.measures["held"]
    for key, share in (("median_error_mm", 0.5), ("p95_error_mm", 0.95)):
        low, high = quantile_bounds(error, share)
        assert low <= published[key] <= high
    otherwise = OTHERWISE / len(error) + 1e-9
    for key, values in (("success", held), ("team_success", held.max(-1))):
        low, high = (np.mean(values < 2 + moved) for moved in (-MOVED_MM, MOVED_MM))
        assert low - otherwise <= published[f"{key}_2mm"] <= high + otherwise
    touched = played.measures["collided"].any(-1).mean()
    assert published["collision_rate"] == pytest.approx(touched, abs=otherwise)


def quantile_bounds(values: np.ndarray, share: float) -> tuple[float, float]:
    """Where a quantile of [E, A] values may lie: all of them moved, and those of some episodes anywhere."""
    ordered, away = np.sort(values.ravel()), OTHERWISE * values.shape[1]
    rank = share * (len(ordered) - 1)
    low, high = max(int(rank) - away, 0), min(int(np.ceil(rank)) + away, len(ordered) - 1)
    return ordered[low] - MOVED_MM, ordered[high] + MOVED_MM
