"""Draw every arm into its folder (preview.png) and all scenes into one picture.

Run: python -m surgical_marl.studies.previews --results docs; it writes docs/scenes.png.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import imageio.v3 as imageio
import mujoco
import numpy as np

from surgical_marl import list_arms, list_scenes, load_arm, load_scene
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.scenes.scene import Scene
from surgical_marl.studies.command import results_folder
from surgical_marl.view.render import Renderer

DIRECTION = np.array([0.75, 0.60, 0.30])
"""From an arm to the camera."""
COLUMNS, SIZE = 4, (320, 240)
"""Pictures in a row of the gallery, and width and height of each, pixels."""


def picture(scene: Scene, width: int, height: int) -> np.ndarray:
    """Draw the scene with its arms at home, [height, width, 3] uint8."""
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    return Renderer(scene.model, width, height).render(data)


def portrait(name: str, folder: Path) -> np.ndarray:
    """One arm above the field, the camera so far that all of it is seen."""
    path = folder / f"{name}.yaml"
    position = [0.0, 0.0, 0.15] if load_arm(name).remote_center else [-0.52, 0.0, -0.03]
    lines = [f"arms: {{{name}_0: {{arm: {name}, position: {position}}}}}"]
    path.write_text("\n".join(lines))
    scene = load_scene(path)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    parts = data.geom_xpos[scene.model.geom_group != 1]
    centre, size = (parts.min(0) + parts.max(0)) / 2, np.linalg.norm(np.ptp(parts, axis=0))
    at = centre + 1.4 * size * DIRECTION / np.linalg.norm(DIRECTION)
    path.write_text("\n".join([*lines, f"view: {{position: {at.tolist()}, target: {centre.tolist()}}}"]))
    return picture(load_scene(path), 480, 480)


def gallery(names: list[str]) -> np.ndarray:
    """All scenes side by side in rows; what is left of the last row is white."""
    pictures = [picture(load_scene(name), *SIZE) for name in names]
    pictures += [np.full_like(pictures[0], 255)] * (-len(pictures) % COLUMNS)
    rows = [np.concatenate(pictures[i : i + COLUMNS], axis=1) for i in range(0, len(pictures), COLUMNS)]
    return np.concatenate(rows)


def main(argv: list[str] | None = None) -> None:
    results = results_folder(__doc__, argv)
    with tempfile.TemporaryDirectory() as folder:
        for name in list_arms():
            path = load_arm(name).folder / "preview.png"
            imageio.imwrite(path, portrait(name, Path(folder)))
            print(path)
    path = results / "scenes.png"
    imageio.imwrite(path, gallery([*(names := scenes_without_objects()), *sorted({*list_scenes()} - {*names})]))
    print(path)


if __name__ == "__main__":
    main()
