"""Exported data sets, read back; and exports that were ended, refused or asked for twice."""

from __future__ import annotations

import json
import subprocess
from itertools import islice
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from surgical_marl.cli.main import main
from surgical_marl.data import export as exporting
from surgical_marl.data.dataset import read_episode
from surgical_marl.data.export import export
from surgical_marl.data.formats import FORMATS
from surgical_marl.data.recording import Recording, played
from surgical_marl.data.request import Request
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.signals import Signals
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.view.session import Session
from surgical_marl.vision.cameras import Cameras, find_pictures

SETTINGS = Settings(task="reach", scene="psm", seed=3, max_steps=12, device="cpu")
ARM, COUNT, RATE = "psm_0", 3, 25
PICTURES, SIZE = ("outside",), (64, 48)


def request(name: str, **more: Any) -> Request:
    asked = {"policy": "random", "settings": SETTINGS, "episodes": COUNT, "pictures": PICTURES, "size": SIZE}
    return Request(name, **{**asked, **more})


@pytest.fixture(scope="module")
def truth() -> tuple[list[Recording], list[dict[str, np.ndarray]], Signals]:
    """The episodes that all exports here are of, at 25 rows a second, with their pictures."""
    env = make_env(SETTINGS, COUNT, "numpy")
    recordings = [own.every(2) for own in islice(played(env, load_policy("random", env), SETTINGS.seed), COUNT)]
    names = (*PICTURES, "outside_depth", "outside_segmentation")
    cameras = Cameras(env.scene, find_pictures(names, env.scene), SIZE)
    drawn = [list(cameras.draw(own.seen)) for own in recordings]
    pictures = [{name: np.concatenate([part[name] for part in own]) for name in names} for own in drawn]
    return recordings, pictures, Signals(env, "joint")


def needs(name: str) -> None:
    pytest.importorskip(FORMATS[name].needs)


def frames(path: Path) -> np.ndarray:
    """The pictures of a film, [T, H, W, 3]."""
    import imageio_ffmpeg

    command = [
        imageio_ffmpeg.get_ffmpeg_exe(),
        "-loglevel",
        "error",
        "-i",
        str(path),
        "-f",
        "rawvideo",
        "-pix_fmt",
        "rgb24",
        "-",
    ]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, SIZE[1], SIZE[0], 3)


def psnr(first: np.ndarray, second: np.ndarray) -> float:
    """Peak signal-to-noise ratio of two pictures, dB."""
    return float(10 * np.log10(255**2 / np.mean((first.astype(float) - second) ** 2)))


def check_film(path: Path, pictures: np.ndarray) -> None:
    """A film has a frame for each row, each nearer to its own picture than to any other of another look."""
    shown = frames(path)
    assert len(shown) == len(pictures) - 1
    for row, frame in enumerate(shown):
        assert psnr(frame, pictures[row]) > 32
    first, last = pictures[0], pictures[len(shown) - 1]
    assert psnr(shown[0], first) > psnr(shown[0], last) + 3


@pytest.mark.parametrize("name", ["lerobot", "lerobot-2.1"])
def test_lerobot(name: str, tmp_path: Path, truth: Any) -> None:
    needs(name)
    import pyarrow.parquet as pq

    recordings, pictures, signals = truth
    out = export(request(name, rate=RATE), tmp_path / "set")
    table = pq.read_table(sorted((out / "data").rglob("*.parquet")))
    info = json.loads((out / "meta/info.json").read_text())
    lengths = [len(own) for own in recordings]
    assert info["total_frames"] == sum(lengths) and info["fps"] == RATE and info["total_episodes"] == COUNT
    assert {*table.column_names} == {key for key in info["features"] if not key.startswith("observation.images")}

    def stored(key: str) -> np.ndarray:
        return np.array(table[key].to_pylist(), np.float32)

    wanted = {
        "observation.state": [signals.state(own)[:-1] for own in recordings],
        "observation.environment_state": [own.seen["state"][:-1] for own in recordings],
        "action": [signals.action(own) for own in recordings],
        "next.reward": [own.done[f"rewards/{ARM}"] for own in recordings],
        "next.success": [own.done["success"] for own in recordings],
        "timestamp": [np.arange(length) / RATE for length in lengths],
        "frame_index": [np.arange(length) for length in lengths],
        "episode_index": [np.full(length, number) for number, length in enumerate(lengths)],
        "index": [np.arange(sum(lengths))],
    }
    for key, parts in wanted.items():
        assert np.array_equal(stored(key), np.concatenate(parts, dtype=np.float32)), key
    stats = json.loads((out / "meta/stats.json").read_text())
    for key in ("action", "next.reward"):
        values = stored(key).reshape(sum(lengths), -1).astype(float)
        for word, of in {"mean": values.mean(0), "std": values.std(0), "max": values.max(0)}.items():
            np.testing.assert_allclose(stats[key][word], of, rtol=1e-5, atol=1e-7)
    look = pictures[0]["outside"] / 255
    np.testing.assert_allclose(np.ravel(stats["observation.images.outside"]["mean"]), look.mean((0, 1, 2)), atol=0.01)
    for number, path in enumerate(sorted((out / "videos").rglob("*.mp4"))):
        check_film(path, pictures[number]["outside"])


def test_lerobot_knows_where_each_episode_is(tmp_path: Path, truth: Any) -> None:
    needs("lerobot")
    import pyarrow.parquet as pq

    out = export(request("lerobot", rate=RATE), tmp_path / "set")
    rows = pq.read_table(out / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    info, films = json.loads((out / "meta/info.json").read_text()), "videos/observation.images.outside"
    for number, row in enumerate(rows):
        assert row["episode_index"] == number and row["dataset_to_index"] - row["dataset_from_index"] == row["length"]
        place = {"chunk_index": row["data/chunk_index"], "file_index": row["data/file_index"]}
        held = pq.read_table(out / info["data_path"].format(**place)).slice(row["dataset_from_index"], row["length"])
        assert {*held["episode_index"].to_pylist()} == {number}
        place = {"chunk_index": row[f"{films}/chunk_index"], "file_index": row[f"{films}/file_index"]}
        path = out / info["video_path"].format(video_key="observation.images.outside", **place)
        assert len(frames(path)) == row["length"]
    tasks = pq.read_table(out / "meta/tasks.parquet")
    assert tasks["__index_level_0__"].to_pylist() == rows[0]["tasks"]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["__index_level_0__"]


def test_groot_knows_which_numbers_are_whose(tmp_path: Path) -> None:
    needs("lerobot-2.1")
    out = export(request("lerobot-2.1", pictures=(), actions="relative"), tmp_path / "set")
    modality = json.loads((out / "meta/modality.json").read_text())
    assert modality["state"] == {ARM: {"start": 0, "end": 8}} and modality["action"] == {ARM: {"start": 0, "end": 10}}
    lines = [json.loads(line) for line in (out / "meta/episodes.jsonl").read_text().splitlines()]
    assert [line["length"] for line in lines] == [12] * COUNT
    assert "## Synchronization" in (out / "meta/README.md").read_text()


def test_minari(tmp_path: Path, truth: Any) -> None:
    needs("minari")
    from minari import MinariDataset

    recordings, pictures, signals = truth
    names = ("outside", "outside_depth", "outside_segmentation")
    found = MinariDataset(
        export(request("minari", rate=RATE, actions="joint", pictures=names), tmp_path / "set") / "data"
    )
    assert found.total_episodes == COUNT and found.total_steps == sum(map(len, recordings))
    for own, drawn, episode in zip(recordings, pictures, found, strict=True):
        assert np.array_equal(episode.observations["proprioception"], own.seen[f"observations/{ARM}"])
        assert np.array_equal(episode.actions, signals.action(own))
        assert np.array_equal(episode.rewards, own.done[f"rewards/{ARM}"])
        assert np.array_equal(episode.truncations, own.done["truncated"])
        assert all(np.array_equal(episode.observations[name], drawn[name]) for name in names)


def test_minari_makes_the_environment_again(tmp_path: Path) -> None:
    needs("minari")
    from minari import MinariDataset

    found = MinariDataset(export(request("minari", pictures=()), tmp_path / "set") / "data")
    env = found.recover_environment()
    assert env.action_space == found.action_space and env.observation_space == found.observation_space
    assert env.observation_space.contains(found[0].observations[3])
    registered = gymnasium.spec("surgical_marl/Reach-v0")
    assert registered.max_episode_steps != found.env_spec.max_episode_steps and "knowledge" not in registered.kwargs


def test_robomimic(tmp_path: Path, truth: Any) -> None:
    needs("robomimic")
    import h5py

    recordings, pictures, signals = truth
    out = export(request("robomimic", rate=RATE, actions="joint"), tmp_path / "set")
    with h5py.File(out / "episodes.hdf5") as file:
        assert file["data"].attrs["total"] == sum(map(len, recordings))
        assert json.loads(file["data"].attrs["env_args"])["env_name"] == "surgical_marl/reach"
        for number, own in enumerate(recordings):
            demo, state = file[f"data/demo_{number}"], signals.state(own)
            assert demo.attrs["num_samples"] == len(own) and demo.attrs["model_file"].startswith("<mujoco")
            wanted = {
                "actions": signals.action(own), "rewards": own.done[f"rewards/{ARM}"], "states": own.seen["qpos"][:-1],
                "obs/state": state[:-1], "next_obs/state": state[1:],
                "obs/outside_image": pictures[number]["outside"][:-1],
                "dones": np.arange(len(own)) == len(own) - 1,
            }  # fmt: skip
            for name, values in wanted.items():
                assert np.array_equal(demo[name], values), name
        assert [name.decode() for name in file["mask/train"]] == [f"demo_{number}" for number in range(COUNT)]


def test_mcap(tmp_path: Path, truth: Any) -> None:
    needs("mcap")
    from rosbags.highlevel import AnyReader

    recordings, _, signals = truth
    out = export(request("mcap", rate=RATE, pictures=()), tmp_path / "set")
    for number, own in enumerate(recordings):
        with AnyReader([out / f"episode_{number:06d}"]) as bag:
            said: dict[str, list[tuple[int, Any]]] = {}
            for connection, when, raw in bag.messages():
                said.setdefault(connection.topic, []).append((when, bag.deserialize(raw, connection.msgtype)))
        arm = signals.measured(own, ARM)[:-1].astype(float)
        joints = np.stack([message.position for _, message in said[f"/{ARM}/measured_js"]])
        jaw = np.stack([message.position for _, message in said[f"/{ARM}/jaw/measured_js"]])
        assert np.array_equal(np.concatenate([joints, jaw], 1), arm)
        assert said[f"/{ARM}/jaw/measured_js"][0][1].name == ["jaw"]
        assert [when for when, _ in said["/success"]] == [round(row * 1e9 / RATE) for row in range(len(own))]
        assert {len(messages) for messages in said.values()} == {len(own)}


def content(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_an_export_that_was_ended_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("lerobot")
    asked = request("lerobot", rate=RATE)
    whole = export(asked, tmp_path / "whole")
    written: list[int] = []
    add = exporting.add_episode

    def killed(folder: Path, number: int, *rest: Any) -> None:
        if number == 2 and len(written) < 3:
            (folder / f"episode-{number:06d}-outside.mp4").write_bytes(b"half")
            raise KeyboardInterrupt
        add(folder, number, *rest)
        written.append(number)

    monkeypatch.setattr(exporting, "add_episode", killed)
    with pytest.raises(KeyboardInterrupt):
        export(asked, tmp_path / "set")
    assert not (tmp_path / "set").exists() and (tmp_path / ".set.partial").is_dir()
    with pytest.raises(ValueError, match=r"holds the part of an export with rate 25, not 50: repeat that command"):
        export(request("lerobot"), tmp_path / "set")
    written.append(-1)  # from now on nothing ends it
    assert content(export(asked, tmp_path / "set")) == content(whole)
    assert written == [0, 1, -1, 2] and not (tmp_path / ".set.partial").exists()


def test_what_is_written_last_is_the_whole_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A set that can't be finished is not there, and its episodes are."""
    needs("robomimic")

    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(exporting, "write_text", full)
    with pytest.raises(OSError, match="No space left"):
        export(request("robomimic", pictures=()), tmp_path / "set")
    monkeypatch.undo()
    assert not (tmp_path / "set").exists()
    assert len(read_episode(tmp_path / ".set.partial", COUNT - 1).recording) == 12
    assert (export(request("robomimic", pictures=()), tmp_path / "set") / "episodes.hdf5").is_file()


def test_only_success(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    needs("robomimic")
    settings = Settings(task="reach", scene="psm", seed=3, max_steps=60, device="cpu")
    oracle = request("robomimic", policy="oracle", settings=settings, only_success=True, pictures=(), episodes=2)
    assert json.loads((export(oracle, tmp_path / "set") / "export.json").read_text())["only_success"]
    monkeypatch.setattr(exporting, "TRIES", 4)
    with pytest.raises(ValueError, match=r"^0 of 4 episodes of 'zero' succeed: choose another policy"):
        export(request("robomimic", policy="zero", only_success=True, pictures=()), tmp_path / "none")
    assert not (tmp_path / ".none.partial").exists()


def test_takes_are_exported_in_any_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    needs("robomimic")
    import h5py

    session = Session(SETTINGS, "random", num_envs=2, record=tmp_path / "takes")
    for _ in range(18):
        session.step()
    session.close()
    take, out = str(tmp_path / "takes/take-0001.npz"), tmp_path / "set"
    command = ["export", "episodes", take, "--format", "robomimic"]
    assert main([*command, "--out", str(out), "--actions", "relative", "--cameras", "outside", "--size", "32x32"]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    with h5py.File(out / "episodes.hdf5") as file:
        assert [len(file[f"data/demo_{number}/actions"]) for number in range(4)] == [12, 12, 6, 6]
        assert file["data/demo_3/obs/outside_image"].shape == (6, 32, 32, 3)
        assert file["data/demo_3/actions"].shape == (6, 10)
    assert main([*command, "--out", str(tmp_path / "two"), "--episodes", "2"]) == 0
    assert json.loads((tmp_path / "two/export.json").read_text())["takes"][0][0] == "take-0001.npz"
    with h5py.File(tmp_path / "two/episodes.hdf5") as file:
        assert len(file["data"]) == 2
    capsys.readouterr()
    assert main([*command, "--out", str(tmp_path / "none"), "--only-success"]) == 2
    assert "the takes hold no whole episode that succeeds" in capsys.readouterr().err
    assert not list(tmp_path.glob(".none*")), "there is nothing to go on with"
    assert main([*command, "--out", str(tmp_path / "new"), "--policy", "zero"]) == 2
    assert "a take says itself what it is of: leave out --policy" in capsys.readouterr().err


COMMAND = ["export", "episodes", "reach", "--scene", "psm", "--format", "robomimic", "--out", "new"]


@pytest.mark.parametrize(
    "argv, words",
    [
        (["export", "episodes"], ["TASK|TAKE.npz", "--format", "--out"]),
        (["export", "episodes", "reech", "--format", "mcap", "--out", "new"], ["'reech'", "did you mean 'reach'"]),
        (["export", "episodes", "reach", "track", "--format", "mcap", "--out", "new"], ["one task", "'track'"]),
        (["export", "episodes", "none.npz", "--format", "mcap", "--out", "new"], ["there is no file none.npz"]),
        (["export", "episodes", "none.npz", "reach", "--format", "mcap", "--out", "new"], ["leave out 'reach'"]),
        ([*COMMAND, "--format", "rlds"], ["'rlds'", "lerobot, lerobot-2.1, minari, robomimic, mcap"]),
        ([*COMMAND, "--cameras", "inside"], ["'inside'", "outside"]),
        ([*COMMAND, "--cameras", "endoscope"], ["'endoscope'", "scene 'psm'", "outside"]),
        ([*COMMAND, "--size", "63x48"], ["63x48", "even"]),
        ([*COMMAND, "--rate", "30"], ["1, 2, 5, 10, 25 or 50", "30"]),
        ([*COMMAND, "--rate", "25"], ["--actions env", "--rate", "joint"]),
        ([*COMMAND, "--actions", "pose"], ["'pose'", "relative"]),
        ([*COMMAND, "--format", "mcap", "--actions", "joint"], ["mcap", "leave --actions out"]),
        ([*COMMAND, "--actions", "joint", "--control", "torque", "--policy", "zero"], ["'torque'", "position"]),
        ([*COMMAND, "--policy", "nobody"], ["'nobody'", "oracle"]),
        ([*COMMAND, "--episodes", "0"], ["'0'"]),
        ([*COMMAND[:-1], "old"], ["old exists already"]),
    ],
)
def test_bad_input_is_one_sentence_and_code_2(
    argv: list[str],
    words: list[str],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    needs("robomimic")
    needs("mcap")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").mkdir()
    (tmp_path / "old/file").touch()
    assert main(argv) == 2
    out, err = capsys.readouterr()
    assert not out and [line for line in err.splitlines() if "preparing" not in line] == [err.splitlines()[-1]]
    for word in words:
        assert word in err
    assert [path.name for path in tmp_path.iterdir()] == ["old"], "bad input must leave nothing behind"


def test_a_format_without_depth_says_so(tmp_path: Path) -> None:
    needs("lerobot")
    with pytest.raises(
        ValueError, match=r"format lerobot has no pictures of depth: leave out outside_depth, and keep outside"
    ):
        export(request("lerobot", pictures=("outside", "outside_depth")), tmp_path / "set")


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    for name, chosen in FORMATS.items():
        with pytest.raises(
            ValueError, match=rf"package {chosen.needs} is not installed: pip install 'surgical-marl\[data\]'"
        ):
            export(request(name), tmp_path / "set")
