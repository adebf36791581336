"""Draw every arm, object and scene, film every task, and write the page that shows them all.

Run: python -m docs.studies.gallery --results docs; it writes docs/gallery.md, docs/images/ and each arm's
preview.png. Clips show the policy that ships for the scene of a task with the most arms, or the oracle where none
ships. `--only NAME ...` draws what has these names alone, and leaves the page.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import mujoco
import numpy as np
from PIL import Image

from docs.studies.command import make_parser, run
from surgical_marl import (
    list_arms,
    list_objects,
    list_policies,
    list_scenes,
    list_tasks,
    load_arm,
    load_object,
    load_scene,
)
from surgical_marl.plugins.tasks import scene_of
from surgical_marl.robots.spec import VISUAL_GROUP
from surgical_marl.scenes.objects import Placement
from surgical_marl.scenes.placing import PlacementEntry, add_bars, add_objects, scenes_without_objects, soft_systems
from surgical_marl.scenes.scene import Scene
from surgical_marl.untrusted.schema import Place
from surgical_marl.view.camera import best_view
from surgical_marl.view.drawn import Extra
from surgical_marl.view.lighting import PLAIN
from surgical_marl.view.render import Renderer, View
from surgical_marl.view.shading import CLOTH, Material, named
from surgical_marl.view.stage import paint, stage
from surgical_marl.view.tracer import PLANE
from surgical_marl.vision.skin import skins

Picture = Any

SMALL, LARGE, CLIP, WIDE = (320, 240), (480, 360), (480, 270), (960, 540)
"""Width and height of pictures, of an arm's portrait, of clips, and of the clip on the first page, pixels."""
FIRST = "needle_handover"
"""The task on the first page."""
COLUMNS = 4
"""Scenes in a row of the picture of all scenes, and cells in a row of the page."""
FPS, SECONDS, STAGED = 12.5, 6.0, 15.0
"""Frames a second of clips, and how long they are at most; those of tasks with stages, which end once they are done."""
QUALITY = 80
"""Of webp pictures, from 0 to 100."""
ARM_AZIMUTH, ARM_ELEVATION = 219.0, -18.0
OBJECT_AZIMUTH, OBJECT_ELEVATION = 240.0, -35.0


def scene_picture(scene: Scene) -> Picture:
    """Draw the scene with its arms at home, [height, width, 3] uint8."""
    own = skins(scene.systems, scene.model)
    return Renderer(scene.model, *SMALL, stage(scene), paint(scene), own).render(_at_home(scene), best_view(scene))


def arm_picture(name: str, folder: Path) -> Picture:
    """Draw one arm above the field, from so far that all of it is seen; `folder` gets the scene."""
    path = folder / f"{name}.yaml"
    position = [0.0, 0.0, 0.15] if load_arm(name).remote_center else [-0.52, 0.0, -0.03]
    path.write_text(f"arms: {{{name}_0: {{arm: {name}, position: {position}}}}}\n", encoding="utf-8")
    scene = load_scene(path)
    data = _at_home(scene)
    parts = data.geom_xpos[scene.model.geom_group == VISUAL_GROUP]
    centre, size = (parts.min(0) + parts.max(0)) / 2, float(np.linalg.norm(np.ptp(parts, axis=0)))
    view = View(tuple(centre.tolist()), 1.5 * size, ARM_AZIMUTH, ARM_ELEVATION, 42.0)
    return Renderer(scene.model, *LARGE, stage(scene)).render(data, view)


def object_picture(name: str) -> Picture:
    """Draw one object on a white ground."""
    spec = mujoco.MjSpec()
    placed = {name: Placement(load_object(name), np.zeros(3), np.eye(3))}
    systems = soft_systems(placed, {name: PlacementEntry(name)}, Place(), {name: {}})
    add_bars(spec, systems)
    if not placed[name].object.soft:
        add_objects(spec, placed)
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    lowest = min(float(data.geom_xpos[geom][2] - _reach(model, data, geom)) for geom in range(model.ngeom))
    white = Material(np.array([0.72, 0.74, 0.76]), CLOTH, int(PLAIN))
    ground = Extra(int(PLANE), (0.0, 0.0, 0.0), np.array([0.0, 0.0, lowest]), np.eye(3), white)
    low, high = data.geom_xpos.min(0), data.geom_xpos.max(0)
    far = 1.5 * model.stat.extent
    view = View(((low + high) / 2).tolist(), far, OBJECT_AZIMUTH, OBJECT_ELEVATION)
    return Renderer(model, *SMALL, [ground], named(model, placed), skins(systems, model)).render(data, view)


def clip(task: str, path: Path) -> str:
    """Film a task, and return a sentence that says what is seen."""
    from surgical_marl.evaluation.environment import common_settings
    from surgical_marl.runs.settings import make_env
    from surgical_marl.view.film import Look, pictures
    from surgical_marl.view.movers import Movers
    from surgical_marl.view.video import write_video

    who, scene = player(task)
    settings = common_settings([who], {"task": task, "scene": scene, "goals": "training"})
    env = make_env(replace(settings, seed=0), 1, "numpy")
    look = Look(size=WIDE if task == FIRST else CLIP, fps=FPS)
    shown = islice(pictures(env, Movers(env, who), look), round(FPS * (STAGED if env.task.stages else SECONDS)))
    write_video(path, shown, FPS)
    env.close()
    return f"`{task}` on `{scene}`, moved by {'the oracle' if who == 'oracle' else f'`{who}`'}"


def player(task: str) -> tuple[str, str]:
    """Return who plays a task, and on which scene: the shipped policy with the most arms, or the oracle."""
    known = {f"{task}-{scene}": scene for scene in list_scenes()}
    shipped = [name for name in list_policies() if name in known]
    if shipped:
        best = max(shipped, key=lambda name: len(load_scene(known[name]).agents))
        return best, known[best]
    return "oracle", scene_of(task)


def page(captions: dict[str, str]) -> str:
    """Return the page; `captions` say what the clips of tasks show."""
    arms = [(f"../arms/{name}/preview.png", f"`{name}`: {load_arm(name).description}") for name in list_arms()]
    scenes = [(f"images/scenes/{name}.webp", f"`{name}`: {load_scene(name).description}") for name in list_scenes()]
    objects = [(f"images/objects/{name}.webp", f"`{name}`: {load_object(name).description}") for name in list_objects()]
    tasks = [(f"images/tasks/{task}.webp", captions[task]) for task in list_tasks()]
    parts = [("Tasks", tasks, 2), ("Scenes", scenes, 3), ("Arms", arms, 3), ("Objects", objects, 3)]
    lines = [
        "# Gallery",
        "",
        "`make gallery` draws all of this again. A ring and a ball of the same colour are an arm and its target; a",
        "yellow ball is a target of all arms. Beside a clip are its words, a view from near, and an endoscope's view.",
    ]
    for title, cells, columns in parts:
        lines += ["", f"## {title}", "", "|" + " |" * columns, "|" + "---|" * columns]
        lines += list(_rows(cells, columns))
    return "\n".join(lines) + "\n"


def all_scenes() -> Picture:
    """Return pictures of all scenes in rows, those without objects first; what is left of the last row is white."""
    names = [*(first := scenes_without_objects()), *sorted({*list_scenes()} - {*first})]
    drawn = [scene_picture(load_scene(name)) for name in names]
    drawn += [np.full_like(drawn[0], 255)] * (-len(drawn) % COLUMNS)
    rows = [np.concatenate(drawn[i : i + COLUMNS], axis=1) for i in range(0, len(drawn), COLUMNS)]
    return np.concatenate(rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Draw the gallery; return the exit code."""
    import tempfile

    parser = make_parser(__doc__)
    parser.add_argument("--results", type=Path, default=Path("docs"), metavar="DIR", help="of the page (%(default)s)")
    parser.add_argument("--only", nargs="+", default=[], metavar="NAME", help="arms, objects, scenes and tasks to draw")
    arguments = parser.parse_args(argv)
    images, only = arguments.results / "images", set(arguments.only)
    every = {*list_arms(), *list_objects(), *list_scenes(), *list_tasks()}
    if unknown := sorted(only - every):
        raise ValueError(f"nothing is called {', '.join(unknown)}: there are {', '.join(sorted(every))}")

    def wanted(names: Sequence[str]) -> list[str]:
        return [name for name in names if not only or name in only]

    with tempfile.TemporaryDirectory() as folder:
        for name in wanted(list_arms()):
            path = load_arm(name).folder / "preview.png"
            imageio.imwrite(path, arm_picture(name, Path(folder)))
            print(path, flush=True)
    for name in wanted(list_objects()):
        _save(images / "objects" / f"{name}.webp", object_picture(name))
    for name in wanted(list_scenes()):
        _save(images / "scenes" / f"{name}.webp", scene_picture(load_scene(name)))
    if not only:
        _save(images / "scenes.webp", all_scenes())
    captions = {}
    for task in wanted(list_tasks()):
        path = images / "tasks" / f"{task}.webp"
        path.parent.mkdir(parents=True, exist_ok=True)
        captions[task] = clip(task, path)
        print(path, flush=True)
    if not only:
        (arguments.results / "gallery.md").write_text(page(captions), encoding="utf-8")
        print(arguments.results / "gallery.md")
    return 0


def _at_home(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    return data


def _reach(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> float:
    """Return how far a geom's bounding box reaches above and below its middle, m."""
    return float(np.abs(data.geom_xmat[geom].reshape(3, 3)[2]) @ model.geom_aabb[geom, 3:])


def _rows(cells: list[tuple[str, str]], columns: int) -> Iterator[str]:
    for first in range(0, len(cells), columns):
        row = [f"![]({picture})<br>{words}" for picture, words in cells[first : first + columns]]
        yield "| " + " | ".join(row + [""] * (columns - len(row))) + " |"


def _save(path: Path, picture: Picture) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(picture).save(path, quality=QUALITY, method=6)
    print(path, flush=True)


if __name__ == "__main__":
    sys.exit(run("gallery", main))
