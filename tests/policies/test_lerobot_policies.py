"""Policies of lerobot act here: `pytest tests/policies/test_lerobot_policies.py -m slow` where lerobot is installed."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surgical_marl.cli.main import main
from surgical_marl.data.export import export
from surgical_marl.data.request import Request
from surgical_marl.runs.settings import Settings

pytestmark = pytest.mark.slow
lerobot = pytest.importorskip("lerobot")
SETTINGS = Settings(task="reach", scene="psm", device="cpu", max_steps=50)
RATE, CAMERA = 25, "observation.images.outside"


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    asked = Request("lerobot", settings=SETTINGS, episodes=4, pictures=("outside",), size=(96, 96), rate=RATE)
    return export(asked, tmp_path_factory.mktemp("set") / "set")


def trained(kind: str, root: Path, out: Path, pictures: bool, **settings: Any) -> tuple[Path, Any]:
    """Train a policy for two steps as `lerobot-train` does, and write it; return its folder and a batch."""
    import torch
    from lerobot.configs.types import FeatureType
    from lerobot.datasets.factory import resolve_delta_timestamps
    from lerobot.datasets.lerobot_dataset import LeRobotDataset, LeRobotDatasetMetadata
    from lerobot.datasets.utils import dataset_to_policy_features
    from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

    about = LeRobotDatasetMetadata("local/set", root=root)
    features = dataset_to_policy_features(about.features)
    given = {name: own for name, own in features.items() if own.type is not FeatureType.ACTION}
    config = make_policy_config(
        kind,
        input_features={name: own for name, own in given.items() if pictures or name != CAMERA},
        output_features={name: own for name, own in features.items() if own.type is FeatureType.ACTION},
        device="cpu",
        push_to_hub=False,
        **settings,
    )
    policy = get_policy_class(kind)(config).train()
    before, after = make_pre_post_processors(config, dataset_stats=about.stats)
    deltas = resolve_delta_timestamps(config, about)
    data = LeRobotDataset("local/set", root=root, delta_timestamps=deltas)
    batch: Any = {}
    optimizer = torch.optim.Adam(policy.parameters(), 1e-4)
    for number, batch in enumerate(torch.utils.data.DataLoader(data, batch_size=8, shuffle=True)):
        loss, _ = policy.forward(before(batch))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if number == 1:
            break
    for part in (policy, before, after):
        part.save_pretrained(out)
    (out / "train_config.json").write_text(json.dumps({"dataset": {"repo_id": "local/set", "root": str(root)}}))
    return out, policy


SMALL = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 64, "n_encoder_layers": 1, "n_vae_encoder_layers": 1,
         "pretrained_backbone_weights": None, "chunk_size": 8, "n_action_steps": 5}  # fmt: skip
UNET = {"down_dims": (16, 32), "horizon": 8, "n_obs_steps": 2, "n_action_steps": 4, "num_inference_steps": 2,
        "diffusion_step_embed_dim": 16, "crop_shape": (84, 84), "spatial_softmax_num_keypoints": 4}  # fmt: skip


@pytest.mark.parametrize("kind, settings, pictures", [("act", SMALL, True), ("act", SMALL, False),
                                                      ("diffusion", UNET, True)])  # fmt: skip
def test_what_lerobot_trained_acts_here(
    demonstrations: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, settings: Any, pictures: bool
) -> None:
    folder, _ = trained(kind, demonstrations, tmp_path / kind, pictures, **settings)
    asked = ["eval", f"lerobot:{folder}", "--task", "reach", "--scene", "psm", "--episodes", "3", "--json"]
    capsys.readouterr()
    assert main(asked) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["episodes"] == 3 and np.isfinite(result["median_error_mm"])
    assert main([*asked[:5], "ecm", *asked[6:]]) == 2
    assert "joint actions in scene 'ecm' are ecm_0/" in capsys.readouterr().err


def test_the_adapter_answers_as_lerobot_itself(demonstrations: Path, tmp_path: Path) -> None:
    """The first answers are those of `select_action`, after the same processing, of the same observations."""
    import torch
    from lerobot.policies.factory import make_pre_post_processors

    from surgical_marl.policies.adapters.lerobot import LeRobotPolicy

    rng = np.random.default_rng(0)
    for kind, settings in (("act", SMALL), ("diffusion", UNET)):
        folder, policy = trained(kind, demonstrations, tmp_path / kind, True, **settings)
        adapter = LeRobotPolicy(str(folder))
        assert (adapter.rate, adapter.actions, adapter.horizon) == (RATE, "joint", settings["n_action_steps"])
        batch: dict[str, Any] = {"task": ["reach"] * 2}
        for name, shape in adapter.observes.items():
            if name != "task":
                values = rng.uniform(0, 1, (2, adapter.history, *shape))
                batch[name] = (255 * values).astype(np.uint8) if name == CAMERA else values.astype(np.float32)
        torch.manual_seed(0)
        found = adapter.act(batch)
        assert found.shape == (2, adapter.horizon, 7)
        before, after = make_pre_post_processors(policy.config, str(folder))
        policy.eval().reset()
        torch.manual_seed(0)
        if kind == "diffusion":  # its own queues are filled by a first look, whose answer is not wanted
            policy._queues["action"].extend([torch.zeros(2, 7)])
        for row in range(adapter.history):
            now: dict[str, Any] = {
                key: torch.from_numpy(values[:, row]) for key, values in batch.items() if key != "task"
            }
            now[CAMERA] = now[CAMERA].movedim(-1, 1).float() / 255
            answer = policy.select_action(before({**now, "task": batch["task"]}))
        np.testing.assert_allclose(found[:, 0], after(answer).numpy(), rtol=1e-4, atol=1e-5)
