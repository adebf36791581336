"""The page that lies beside a data set, in Markdown. It has the headings that Open-H's checker looks for."""

from __future__ import annotations

from string import Template
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from surgical_marl.data.dataset import Dataset

_PAGE = Template("""---
task_categories: [robotics]
tags: [LeRobot, surgical-robotics, simulation]
---
# $title

## Dataset description

$language

$count, $rate rows a second, in the format $format. `export.json` says how they were made, with versions.

- state: $states
- action (`$form`): $actions

## Robot

$arms of the scene `$scene`, simulated by surgical-marl. Joints are in rad or m, tips in their arm's base frame in m.

## Sensor

$sensors

## Collection procedure

$made

## Synchronization

A row is one instant of the simulation: state and pictures are of the same physics step. An action is what was commanded
from there to the next row.
""")


def card_of(dataset: Dataset) -> str:
    """Return the page of a data set."""
    about, scene, signals = dataset.about, dataset.env.scene, dataset.signals
    width, height = dataset.size
    pictures = ", ".join(picture.name for picture in dataset.pictures)
    source = (
        f"takes of people and policies ({len(about['takes'])})" if about["takes"] else f"the policy `{about['policy']}`"
    )
    chosen = "; only episodes that succeed" if about["only_success"] else ""
    arms = ", ".join(f"{agent} (`{mount.arm.name}`)" for agent, mount in scene.mounts.items())
    return _PAGE.substitute(
        title=f"{dataset.env.task_name} on {scene.name}",
        language=dataset.language,
        count=f"{dataset.count} episodes",
        rate=dataset.rate,
        format=about["format"],
        form=signals.form,
        states=", ".join(signals.state_names),
        actions=", ".join(signals.action_names),
        arms=arms,
        scene=scene.name,
        sensors=f"Encoders of all joints. Pictures of {width} x {height} pixels: {pictures}."
        if pictures
        else "Encoders of all joints.",
        made=f"Episodes of {source}, seed {about['seed']}{chosen}.",
    )
