"""Measures what the largest files that are read take, and files just beyond the limits (docs/reliability.md).

    python -m docs.studies.limits

Each file is read in a process of its own, which has imported what it needs and has empty caches.
"""

from __future__ import annotations

import multiprocessing
import os
import resource
import tempfile
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh  # noqa: F401  # so that its import is not measured

from docs.studies.command import make_parser
from surgical_marl.robots.arm import load_arm
from surgical_marl.robots.mesh import MAX_MESH, MAX_TEXT, read_mesh
from surgical_marl.robots.spec import build_spec
from surgical_marl.runs.settings import read_config
from surgical_marl.scenes.load import load_scene
from surgical_marl.scenes.objects import load_object
from surgical_marl.untrusted.arrays import read_npz
from surgical_marl.yaml_file import MAX_YAML, read_yaml

SHAPE = '<collision><geometry><sphere radius="0.01"/></geometry></collision>'
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'

DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1"><library_geometries>
<geometry id="g"><mesh><source id="s"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 0 0 1</float_array>
<technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION"
source="#s"/></vertices><triangles count="{count}"><input semantic="VERTEX" source="#v" offset="0"/><p>{indices}</p>
</triangles></mesh></geometry></library_geometries><library_visual_scenes><visual_scene id="w"><node id="n">
<instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""


def main(argv: list[str] | None = None) -> None:
    """Print a table: what is read, the seconds of a core, the memory in MB, and how it ends."""
    make_parser(__doc__).parse_args(argv)
    print(f"{'file':40} {'s':>5} {'MB':>5}  outcome")
    with tempfile.TemporaryDirectory() as name:
        for what, read in cases(Path(name)).items():
            seconds, memory, outcome = measured(read, Path(name) / "cache")
            print(f"{what:40} {seconds:5.1f} {memory:5.0f}  {outcome.replace(name, '')[:90]}", flush=True)


def measured(read: Callable[[], Any], caches: Path) -> tuple[float, float, str]:
    """Return the seconds and the MB that a call takes in a process of its own, and its error or "read"."""
    context: Any = multiprocessing.get_context("fork")
    answers = context.SimpleQueue()

    def answer() -> None:
        os.environ["XDG_CACHE_HOME"] = str(caches)
        before, began = _peak(), time.process_time()
        try:
            read()
            outcome = "read"
        except ValueError as error:
            outcome = f"refused: {error}"
        answers.put((time.process_time() - began, _peak() - before, outcome))

    process = context.Process(target=answer)
    process.start()
    found: tuple[float, float, str] = answers.get()
    process.join()
    return found


def cases(folder: Path) -> dict[str, Callable[[], Any]]:
    """Write the files, and return what reads each of them."""
    found: dict[str, Callable[[], Any]] = {}
    for count in (6, 12, 30):
        arms = "".join(f"  psm_{k}: {{arm: psm, position: [{0.1 * k}, 0, 0]}}\n" for k in range(count))
        found[f"scene of {count} arms beside each other"] = _text(folder, f"{count}.yaml", f"arms:\n{arms}", load_scene)
    for links, shapes in ((25, 1), (100, 1), (10, 10), (10, 20)):
        urdf = _chain(folder / f"chain{links}x{shapes}", links, shapes)
        text = f"arms: {{{urdf.name}_0: {{arm: {urdf}}}}}"
        found[f"arm of {links} joints, {links * shapes} shapes"] = _text(folder, f"{urdf.name}.yaml", text, load_scene)
    found["arm of 20,000 links"] = _arm(_chain(folder / "long", 20_000, 0))
    part = "{shape: box, size: [0.1, 0.1, 0.1], colour: [1, 0, 0]}"
    for count in (200, 10_000):
        pieces = ", ".join(f"t{k}: {part}" for k in range(count))
        text = f"arms: {{psm_0: {{arm: psm}}}}\ntissue: {{{pieces}}}"
        found[f"scene of {count:,} pieces of tissue"] = _text(folder, f"tissue{count}.yaml", text, load_scene)
    spheres = "{sphere: {radius: 0.01}}, " * 400
    rest = "free: true\nmass: 1\nfriction: {sliding: 1, torsion: 0}\nstiffness: 1.0e+5\n"
    found["object of 400 shapes"] = _text(folder, "object.yaml", f"{rest}shapes: [{spheres}]", load_object)
    for what, values in (("lists", "[],"), ("numbers", "1,")):
        text = f"a: [{values * (MAX_YAML // len(values) - 3)}]"
        found[f"YAML of 1 MB of {what}"] = _text(folder, f"{what}.yaml", text, read_yaml)
    found["YAML of 49,000 values"] = _text(folder, "values.yaml", f"a: [{'1,' * 49_000}]", read_yaml)
    found["YAML of 1 MB of brackets"] = _text(folder, "deep.yaml", f"a: {'[' * 900_000}", read_config)
    found["OBJ of 10 MB"] = _text(folder, "faces.obj", "v 0 0 0\n" * 4 + "f 1 2 3 4\n" * (MAX_TEXT // 11), read_mesh)
    triangles = (MAX_MESH - 84) // 50
    corners = np.random.default_rng(0).uniform(-1, 1, (triangles, 12)).astype("<f4")
    facets = np.concatenate([corners.view(np.uint8), np.zeros((triangles, 2), np.uint8)], 1)
    (folder / "part.stl").write_bytes(bytes(80) + triangles.to_bytes(4, "little") + facets.tobytes())
    found["STL of 25 MB"] = lambda: read_mesh(folder / "part.stl")
    text = DAE.format(indices="0 1 2 " * (MAX_TEXT // 6 - 200), count=MAX_TEXT // 6 - 200)
    found["DAE of 10 MB"] = _text(folder, "faces.dae", text, read_mesh)
    nodes = "".join(f'<node id="n{k}">' + f'<instance_node url="#n{k + 1}"/>' * 2 + "</node>" for k in range(30))
    text = f'<COLLADA>{nodes}<node id="n30"><instance_geometry url="#g"/></node>'
    text += '<visual_scene><instance_node url="#n0"/></visual_scene></COLLADA>'
    found["DAE of a billion nodes"] = _text(folder, "nodes.dae", text, read_mesh)
    found["npz that unpacks to 2 GB"] = _bomb(folder / "bomb.npz")
    return found


def _text(folder: Path, name: str, text: str, read: Callable[[Path], Any]) -> Callable[[], Any]:
    (folder / name).write_text(text, encoding="utf-8")
    return lambda: read(folder / name)


def _arm(folder: Path) -> Callable[[], Any]:
    return lambda: build_spec(load_arm(folder)).compile()


def _chain(folder: Path, links: int, shapes: int) -> Path:
    """Write an arm of revolute joints in a row, each link with some shapes."""
    folder.mkdir()
    urdf, drives = '<link name="l0"/>', ""
    for k in range(1, links + 1):
        urdf += f'<link name="l{k}">{INERTIAL}{SHAPE * shapes}</link><joint name="j{k}" type="revolute">'
        urdf += f'<origin xyz="0 0 0.05"/><parent link="l{k - 1}"/><child link="l{k}"/>{LIMIT}'
        urdf += '<axis xyz="0 1 0"/></joint>'
        drives += f"  j{k}: {{stiffness: 10, damping: 1, speed: 1}}\n" if links < 1000 else ""
    (folder / "chain.urdf").write_text(f'<robot name="chain">{urdf}</robot>', encoding="utf-8")
    (folder / "arm.yaml").write_text(f"urdf: chain.urdf\ntool_tip: l{links}\njoints:\n{drives}", encoding="utf-8")
    return folder


def _bomb(path: Path) -> Callable[[], Any]:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("a.npy", "w") as file:
        for _ in range(200):
            file.write(bytes(10_000_000))
    return lambda: read_npz(path)


def _peak() -> float:
    """Return the most memory that this process has had, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
