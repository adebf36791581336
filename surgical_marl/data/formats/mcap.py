"""MCAP: a bag of ROS 2 for each episode, with the topics of CRTK (the Collaborative Robotics Toolkit).

    episode_000000/episode_000000.mcap, metadata.yaml

Of each arm: `measured_js` and `setpoint_js` of its joints, `measured_cp` and `setpoint_cp` of its tip in its base
frame, and of its jaw `jaw/measured_js` and `jaw/setpoint_js`; beside these `/<picture>/image/compressed`, `/reward` and
`/success`.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from surgical_marl.data.dataset import Dataset, Episode
from surgical_marl.policies.signals import pose

QUALITY = 95
"""Quality of pictures in JPEG, from 0 to 100."""
JAW = ("jaw",)
"""The joint of a jaw has this name in CRTK, whatever it is called in the URDF."""
STORE = get_typestore(Stores.ROS2_HUMBLE)
_JOINTS, _POSE, _IMAGE = (
    "sensor_msgs/msg/JointState",
    "geometry_msgs/msg/PoseStamped",
    "sensor_msgs/msg/CompressedImage",
)
_FLAG, _NUMBER = "std_msgs/msg/Bool", "std_msgs/msg/Float64"


def write(dataset: Dataset, out: Path) -> None:
    """Write a data set into a new folder."""
    for episode in dataset:
        bag = out / f"episode_{episode.number:06d}"
        with Writer(bag, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
            topics = list(_topics(dataset, episode))
            opened = [writer.add_connection(name, kind, typestore=STORE) for name, kind, _ in topics]
            for row in range(len(episode.recording)):
                when = round(row * 1e9 / dataset.rate)
                for connection, (_, kind, messages) in zip(opened, topics, strict=True):
                    writer.write(connection, when, STORE.serialize_cdr(messages(row, when), kind))


def _topics(dataset: Dataset, episode: Episode) -> Iterator[tuple[str, str, Any]]:
    """Yield the name and the type of each topic, and a function from row and time (ns) to its message."""
    recording = episode.recording
    for agent, mount in dataset.env.scene.mounts.items():
        arm, frame = mount.arm, f"{agent}_base"
        joints = {
            "measured": dataset.signals.measured(recording, agent),
            "setpoint": dataset.signals.command(recording, agent),
        }
        names = [joint.name for joint, jaw in zip(arm.actuated, arm.moves_jaw, strict=True) if not jaw]
        for kind, q in joints.items():
            yield f"/{agent}/{kind}_js", _JOINTS, _joints(names, q[:, ~arm.moves_jaw], frame)
            yield f"/{agent}/{kind}_cp", _POSE, _poses(pose(arm, q), frame)
            if arm.moves_jaw.any():
                yield f"/{agent}/jaw/{kind}_js", _JOINTS, _joints(JAW, q[:, arm.moves_jaw], frame)
    yield "/reward", _NUMBER, lambda row, _: _new(_NUMBER, data=float(recording.reward[row]))
    yield "/success", _FLAG, lambda row, _: _new(_FLAG, data=bool(recording.done["success"][row]))
    for name, pictures in episode.pictures.items():
        yield f"/{name}/image/compressed", _IMAGE, _images(pictures, name)


def _joints(names: Sequence[str], positions: np.ndarray, frame: str) -> Any:
    empty = np.zeros(0)

    def message(row: int, when: int) -> Any:
        own = positions[row].astype(float)
        return _new(_JOINTS, header=_header(when, frame), name=list(names), position=own, velocity=empty, effort=empty)

    return message


def _poses(poses: np.ndarray, frame: str) -> Any:
    def message(row: int, when: int) -> Any:
        place, turn = poses[row, :3].tolist(), poses[row, 3:].tolist()
        point = _new("geometry_msgs/msg/Point", **dict(zip("xyz", place, strict=True)))
        quaternion = _new("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True)))
        placed = _new("geometry_msgs/msg/Pose", position=point, orientation=quaternion)
        return _new(_POSE, header=_header(when, frame), pose=placed)

    return message


def _images(pictures: np.ndarray, frame: str) -> Any:
    def message(row: int, when: int) -> Any:
        packed = io.BytesIO()
        Image.fromarray(pictures[row]).save(packed, "JPEG", quality=QUALITY)
        data = np.frombuffer(packed.getvalue(), np.uint8)
        return _new(_IMAGE, header=_header(when, frame), format="jpeg", data=data)

    return message


def _header(when: int, frame: str) -> Any:
    stamp = _new("builtin_interfaces/msg/Time", sec=when // 10**9, nanosec=when % 10**9)
    return _new("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def _new(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)
