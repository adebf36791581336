"""Policies of other libraries in the loop: what they observe, when they are asked, what their actions do, bad input."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper
from websockets.sync.server import serve

from surgical_marl.cli.main import main
from surgical_marl.data.export import export
from surgical_marl.data.recording import Recording, played
from surgical_marl.data.request import Request
from surgical_marl.envs.batch import BatchedEnv
from surgical_marl.evaluation.goal_set import episode_seed
from surgical_marl.plugins.adapters import ADAPTERS, is_adapted, read_adapted
from surgical_marl.policies.adapter import PolicyAdapter
from surgical_marl.policies.policy import load_policy
from surgical_marl.policies.signals import Signals
from surgical_marl.runs.settings import Settings, make_env
from surgical_marl.vision.cameras import Cameras, find_pictures

SETTINGS = Settings(task="reach", scene="psm", seed=3, max_steps=12, device="cpu")
ARM, MANY, SEED = "psm_0", 2, 5
COMMANDS = ".physics.arms.ctrl"
HERE = ["--task", "reach", "--scene", "psm"]


@pytest.fixture(scope="module")
def env() -> Iterator[BatchedEnv]:
    made = make_env(SETTINGS, MANY, "numpy")
    yield made
    made.close()


@pytest.fixture(scope="module")
def recordings(env: BatchedEnv) -> dict[str, list[Recording]]:
    """The same episodes by who plays them."""
    return {who: list(islice(played(env, load_policy(who, env), SEED), MANY)) for who in ("random", "oracle")}


@pytest.fixture
def mine(monkeypatch: pytest.MonkeyPatch) -> Callable[[type[PolicyAdapter]], None]:
    """Make a class known as the adapter "mine", in this test."""
    monkeypatch.setattr(ADAPTERS, "_registered", {})
    return lambda cls: ADAPTERS.register("mine", cls)


def act_out(env: BatchedEnv, name: str, steps: int = 12) -> tuple[np.ndarray, np.ndarray]:
    """Let a policy play from the start of the recorded episodes.

    Returns:
        Joint positions [N, steps + 1, nq], and commands [N, steps + 1, nu].
    """
    env.autoreset = False
    observations, *_ = env.reset(episode_seed(SEED, 0))
    policy, qpos, commands = load_policy(name, env), [env.qpos.copy()], [env.carry()[COMMANDS]]
    for _ in range(steps):
        observations = env.step(policy(observations)).observations
        qpos.append(env.qpos.copy())
        commands.append(env.carry()[COMMANDS])
    return np.stack(qpos, 1), np.stack(commands, 1)


@pytest.mark.parametrize("form, rate", [("env", 50), ("joint", 50), ("cartesian", 50), ("relative", 50), ("joint", 25),
                                        ("cartesian", 25)])  # fmt: skip
def test_exported_actions_lead_where_they_led(
    env: BatchedEnv, recordings: dict[str, list[Recording]], mine: Any, form: str, rate: int
) -> None:
    """A policy that answers with the actions of a data set sees its columns, and moves arms as they were moved."""
    stride = 50 // rate
    signals = Signals(env, form, stride)
    # within a row joints go straight, which random ones did not
    rows = [own.every(stride) for own in recordings["random" if stride == 1 else "oracle"]]
    states, actions, surroundings = (
        np.stack([of(own) for own in rows]) for of in (signals.state, signals.action, lambda own: own.seen["state"])
    )
    seen: list[Any] = []

    class Echo(PolicyAdapter):
        observes = {"observation.state": None, "observation.environment_state": None, "task": ()}  # noqa: RUF012
        horizon, names = 2, signals.action_names

        def __init__(self, place: str) -> None:
            self.rate, self.actions = rate, place

        def act(self, batch: Any) -> np.ndarray:
            seen.append(batch)
            return actions[:, 2 * len(seen) - 2 : 2 * len(seen)]

    mine(Echo)
    _, commands = act_out(env, f"mine:{form}")
    asked = np.stack([signals.command(own, ARM) for own in rows])
    close = {"env": 1e-7, "joint": 1e-5 * stride**4}.get(form, 3e-4)  # of poses in float32
    np.testing.assert_allclose(commands[:, stride::stride, : asked.shape[2]], asked, atol=close)
    assert len(seen) == 6 // stride and seen[0]["task"] == [seen[0]["task"][0]] * MANY
    assert seen[0]["task"][0].startswith("Every arm brings its tool tip")
    for number, batch in enumerate(seen if stride == 1 else seen[:1]):
        np.testing.assert_allclose(batch["observation.state"][:, 0], states[:, 2 * number], atol=close)
        np.testing.assert_allclose(
            batch["observation.environment_state"][:, 0], surroundings[:, 2 * number], atol=10 * close
        )
    assert np.array_equal(seen[0]["observation.state"][:, 0], states[:, 0])
    assert np.array_equal(seen[0]["observation.environment_state"][:, 0], surroundings[:, 0])


def test_a_policy_sees_its_history_and_is_asked_where_its_answer_is_used_up(env: BatchedEnv, mine: Any) -> None:
    asked: list[np.ndarray] = []

    class Still(PolicyAdapter):
        observes = {"observation.state": (7,), "observation.images.outside": (24, 32, 3)}  # noqa: RUF012
        rate, actions, horizon, history = 25, "joint", 3, 2

        def __init__(self, place: str) -> None:
            pass

        def act(self, batch: Any) -> np.ndarray:
            asked.append(batch["observation.state"])
            assert batch["observation.images.outside"].shape == (len(asked[-1]), 2, 24, 32, 3)
            shown.append(batch["observation.images.outside"])
            return np.repeat(asked[-1][:, -1:], 3, 1) + np.float32(0.05)

    shown: list[np.ndarray] = []
    mine(Still)
    env.autoreset = True
    observations, *_ = env.reset(1)
    env.steps = np.array([0, 8], np.int32)  # the second episode ends after 4 steps, in the middle of an answer
    policy, rows = load_policy("mine:x", env), []
    for _ in range(8):
        rows.append(env.qpos.copy())
        observations = env.step(policy(observations)).observations
    assert [len(batch) for batch in asked] == [2, 1, 1]
    start, of_second, of_first = asked
    assert np.array_equal(start[:, 0], start[:, 1])
    np.testing.assert_allclose(of_second[0], rows[4][[1, 1], :7], atol=1e-6)  # a new episode has no rows before it
    np.testing.assert_allclose(of_first[0], [rows[4][0, :7], rows[6][0, :7]], atol=1e-6)
    assert (shown[0][:, 0] == shown[0][:, 1]).all() and (shown[2][0, 0] != shown[2][0, 1]).any()
    cameras = Cameras(env.scene, find_pictures(["outside"], env.scene), (32, 24))
    drawn = env.drawn_poses
    (now,) = cameras.draw({"qpos": rows[0].astype(np.float32), "origin": drawn.origin, "quaternion": drawn.quaternion})
    assert np.array_equal(now["outside"], shown[0][:, -1])


def onnx_file(path: Path, inputs: dict[str, Any], out: list[Any], **about: str) -> Path:
    """Write a network that keeps joints where they are, and looks at nothing else."""
    state = next(iter(inputs))
    nodes = [helper.make_node("Identity", [state], ["action"])]
    if len(out) == 3:
        nodes = [helper.make_node("Unsqueeze", [state, "axis"], ["one"]),
                 helper.make_node("Expand", ["one", "shape"], ["action"])]  # fmt: skip
    constants = [helper.make_tensor("axis", TensorProto.INT64, [1], [1])]
    constants.append(helper.make_tensor("shape", TensorProto.INT64, [3], [1, out[1] if len(out) == 3 else 1, 1]))
    kinds = {name: TensorProto.UINT8 if shape[-1] == 3 else TensorProto.FLOAT for name, shape in inputs.items()}
    given = [helper.make_tensor_value_info(name, kinds[name], shape) for name, shape in inputs.items()]
    graph = helper.make_graph(
        nodes, "still", given, [helper.make_tensor_value_info("action", TensorProto.FLOAT, out)],
        constants if len(out) == 3 else [],
    )  # fmt: skip
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    helper.set_model_props(model, about)
    onnx.save(model, path)
    return path


STATE = "observation.state"
FILES: dict[str, Any] = {
    "any batch": ({STATE: ["N", 7]}, ["N", 7]),
    "one at a time, in chunks": ({STATE: [1, 7]}, [1, 4, 7]),
    "with a picture and names without dots": (
        {"observation_state": ["N", 7], "observation_images_outside": ["N", 24, 32, 3]}, ["N", 4, 7]),
}  # fmt: skip


@pytest.mark.parametrize("case", FILES)
def test_an_onnx_file_acts(env: BatchedEnv, tmp_path: Path, case: str) -> None:
    path = onnx_file(tmp_path / "still.onnx", *FILES[case], rate="25", actions="joint")
    found, _ = act_out(env, f"onnx:{path},horizon=2" if "chunks" in case else f"onnx:{path}")
    np.testing.assert_allclose(found[:, -1], found[:, 0], atol=2e-3)  # gravity alone moves them a little
    unsaid = onnx_file(tmp_path / "other.onnx", *FILES[case])
    np.testing.assert_array_equal(act_out(env, f"onnx:{unsaid},rate=25,actions=joint")[0][:, 1], found[:, 1])


def packed(value: Any) -> Any:
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    return value


@pytest.fixture
def server() -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """A policy server that speaks as openpi's does: it tells arms to stay, or says what is wrong."""
    got: list[dict[str, Any]] = []
    opened: list[Any] = []

    def answer(socket: Any) -> None:
        opened.append(socket)
        socket.send(msgspec.msgpack.encode({"rate": 10, "actions": "joint", "horizon": 2}))
        for message in socket:
            got.append(msgspec.msgpack.decode(message))
            state = got[-1]["observation.state"]
            if len(got) > 3:
                socket.send("Traceback (most recent call last):\n  ...\nRuntimeError: out of memory")
                return
            own = np.frombuffer(state[b"data"], state[b"dtype"]).reshape(state[b"shape"])
            actions = packed(np.tile(own.astype(np.float64), (5, 1)))
            socket.send(msgspec.msgpack.encode({"actions": actions, "server_timing": {"infer_ms": 1.5}}))

    with serve(answer, "localhost", 0) as running:
        thread = threading.Thread(target=running.serve_forever)
        thread.start()
        yield f"localhost:{running.socket.getsockname()[1]}", got
        for each in opened:  # its thread waits for a message
            each.close()
        running.shutdown()
        thread.join()


def test_a_process_answers_over_a_socket(env: BatchedEnv, server: Any) -> None:
    place, got = server
    found, _ = act_out(env, f"socket:{place},cameras=outside,size=32x24", steps=10)
    np.testing.assert_allclose(found[:, -1], found[:, 0], atol=2e-3)
    assert [sorted(own) for own in got] == [["observation.images.outside", "observation.state", "prompt"]] * MANY
    assert got[0]["observation.images.outside"][b"shape"] == [24, 32, 3] and got[0]["prompt"].startswith("Every arm")
    with pytest.raises(ValueError, match=r"socket:\S+ can't act: the server says: RuntimeError: out of memory$"):
        act_out(env, f"socket:{place}", steps=11)


def test_a_policy_of_a_stranger_plays_and_is_judged(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`docs/your_own_policy.md` shows the adapter of the example plugin, which copies the oracle's demonstrations."""
    from tests.example_plugin.example_plugin.nearest import Nearest
    from tests.helpers import ROOT

    code = (ROOT / "tests/example_plugin/example_plugin/nearest.py").read_text()
    assert code in (ROOT / "docs/your_own_policy.md").read_text() and len(code.splitlines()) <= 60
    monkeypatch.setattr(ADAPTERS, "_registered", {"nearest": Nearest})
    settings = Settings(task="reach", scene="psm", device="cpu", goals="held_out")
    kept = export(Request("lerobot", settings=settings, episodes=8, rate=25), tmp_path / "set")
    assert main(["eval", f"nearest:{kept}", *HERE, "--episodes", "8", "--json"]) == 0
    copied = json.loads(capsys.readouterr().out)
    assert main(["eval", "zero", *HERE, "--episodes", "8", "--json"]) == 0
    still = json.loads(capsys.readouterr().out)
    assert copied["policy"] == f"nearest:{kept}" and copied["goal_set"] == still["goal_set"]
    assert copied["median_error_mm"] < 0.7 * still["median_error_mm"]


@pytest.mark.parametrize("text, wanted", [
    ("onnx:a.onnx", ("onnx", "a.onnx", {})),
    ("onnx:a,b.onnx,rate=25,actions=joint", ("onnx", "a,b.onnx", {"rate": "25", "actions": "joint"})),
    ("socket:localhost:8000,horizon=4", ("socket", "localhost:8000", {"horizon": "4"})),
])  # fmt: skip
def test_names_are_read(text: str, wanted: Any) -> None:
    found = read_adapted(text)
    assert (found.scheme, found.place, dict(found.settings)) == wanted


@pytest.mark.parametrize("text", ["reach-psm", "runs/a:b", "C:/runs/a", "oracle", "./lerobot:x"])
def test_other_names_stay(text: str) -> None:
    assert not is_adapted(text)


BAD = [
    ("torch:a.pt", r"unknown policy adapter 'torch' \(choose from lerobot, onnx, socket\)"),
    ("onnx:{}/none.onnx,rate=25,actions=joint", r"can't be loaded: there is no file \S+none.onnx"),
    ("onnx:{}/text.onnx", r"text.onnx is no ONNX file that onnxruntime reads"),
    ("onnx:{}/still.onnx", "does not say how many rows a second it was trained on: add ,rate=50 to its name, or 1, 2"),
    ("onnx:{}/still.onnx,rate=30", "rate must be 1, 2, 5, 10, 25 or 50, not 30"),
    ("onnx:{}/still.onnx,rate=25", "does not say what its actions are: add ,actions=relative"),
    ("onnx:{}/still.onnx,rate=25,actions=joints", "actions must be env, joint, cartesian or relative, not 'joints'"),
    ("onnx:{}/still.onnx,rate=25,actions=env", "control step"),
    ("onnx:{}/still.onnx,rate=25,action=env", r"unknown setting of onnx: 'action', did you mean 'actions'"),
    ("onnx:{}/still.onnx,rate=25,actions=cartesian", r"of shape \[7\], and cartesian states in scene"),
    ("onnx:{}/wide.onnx,rate=25,actions=joint", r"actions of shape \[2, 1, 30\], and joint actions .* are \[2, 1, 7\]"),
    ("onnx:{}/strange.onnx,rate=25,actions=joint", "has the input tokens: inputs must be among observation.state"),
    ("onnx:{}/still.onnx,rate=25,actions=joint,horizon=x", "horizon must be a whole number of 1 or more, not 'x'"),
    ("socket:localhost", "write socket:HOST:PORT such as socket:localhost:8000"),
    ("socket:localhost:1", "nothing answers at localhost:1"),
    ("lerobot:{}", r"there is no policy of lerobot in \S+: it lacks config.json"),
]  # fmt: skip


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    (folder / "text.onnx").write_text("no")
    onnx_file(folder / "still.onnx", {STATE: ["N", 7]}, ["N", 7])
    onnx_file(folder / "wide.onnx", {"observation.environment_state": ["N", "d"]}, ["N", "d"])
    onnx_file(folder / "strange.onnx", {"tokens": ["N", 7]}, ["N", 7])
    return folder


@pytest.mark.parametrize("name, words", BAD, ids=[words[:40] for _, words in BAD])
def test_bad_input_ends_in_a_sentence(env: BatchedEnv, files: Path, name: str, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        act_out(env, name.format(files), steps=1)


@pytest.mark.parametrize("command", [["eval"], ["crossplay"], ["play", "reach", "--out", "a.mp4", "--policy"]])
def test_commands_name_what_is_wrong_with_a_policy(command: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*command, "onxx:a.onnx"]) == 2
    assert "unknown policy adapter 'onxx', did you mean 'onnx'" in capsys.readouterr().err


def test_a_policy_without_a_task_needs_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", "onnx:a.onnx"]) == 2
    assert "eval onnx:a.onnx needs --task" in capsys.readouterr().err
