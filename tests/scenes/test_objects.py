"""Objects: their files, their places in scenes, and the plates that hold them."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.cli.main import main
from surgical_marl.content import content_dir
from surgical_marl.robots.inverse_kinematics import inverse_kinematics
from surgical_marl.robots.rotation import matrix_of
from surgical_marl.robots.spec import PAD_GROUP
from surgical_marl.scenes.check import check
from surgical_marl.scenes.objects import Object, load_object
from surgical_marl.scenes.placing import scenes_without_objects
from surgical_marl.vision.endoscope import Endoscope
from tests.helpers import ROOT
from tests.helpers.devices import skip_where_warp_lacks

PAGE = (ROOT / "docs" / "your_own_object.md").read_text()
FILE, SCENE = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
(CODE,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
WITH_OBJECTS = sorted({*sm.list_scenes()} - {*scenes_without_objects()})
RIGID = [name for name in sm.list_objects() if not load_object(name).soft]
FREE = [name for name in RIGID if load_object(name).free]


def ends(item: Object) -> np.ndarray:
    """Where the axes of its capsules begin and end, [shapes, 2, 3]."""
    return np.array([[s.position - w, s.position + w] for s in item.shapes for w in [s.rotation[:, 2] * s.size[1]]])


# -- what ships


@pytest.mark.parametrize(
    ("name", "radius", "wire", "grams"), [("needle_sh", 8.2, 0.66, 0.0696), ("needle_40", 20, 1, 0.39)]
)
def test_a_needle_is_a_half_circle_of_steel(name: str, radius: float, wire: float, grams: float) -> None:
    """Arc, mass, centre of mass and inertia as the formulas of a bent wire have them."""
    item, radius, wire = load_object(name), radius / 1000, wire / 1000
    points = ends(item)
    assert len(item.shapes) == 8 and all(shape.size[0] == pytest.approx(wire / 2) for shape in item.shapes)
    np.testing.assert_allclose(np.linalg.norm(points, axis=-1), radius)
    np.testing.assert_allclose(points[1:, 0], points[:-1, 1], atol=1e-12)
    length = np.linalg.norm(points[:, 1] - points[:, 0], axis=-1).sum()
    assert length == pytest.approx(math.pi * radius, rel=0.01)
    assert item.mass == pytest.approx(7900 * math.pi * (wire / 2) ** 2 * math.pi * radius, rel=1e-9)
    assert 1000 * item.mass == pytest.approx(grams, rel=0.005)
    np.testing.assert_allclose(item.center, [0, 2 * radius / math.pi, 0], atol=0.015 * radius)
    about_middle = item.mass * radius**2 * (1 - 2 / 3 * math.sin(math.pi / 16) ** 2)  # of eight chords, not of the arc
    assert item.inertia[2, 2] == pytest.approx(about_middle - item.mass * item.center[1] ** 2, rel=0.01)
    for site, point in (("tip", [-radius, 0, 0]), ("tail", [radius, 0, 0]), ("grasp", [0, radius, 0])):
        np.testing.assert_allclose(item.sites[site][0], point)
    along = item.sites["grasp"][1][:, 0]
    np.testing.assert_allclose(along, [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(item.sites["tip"][1][:, 0], [0, -1, 0], atol=1e-12)


def test_the_board_of_icra_2026_is_as_in_the_challenge() -> None:
    board = load_object("peg_board_icra2026")
    plate, wall, *pegs = board.shapes
    np.testing.assert_allclose(2 * plate.size, [0.2, 0.1, 0.015])
    np.testing.assert_allclose(plate.position, [0, 0, -plate.size[2]], atol=1e-12)
    np.testing.assert_allclose(2 * wall.size, [0.004, 0.08, 0.1])
    np.testing.assert_allclose(wall.position - wall.size, [-0.002, -0.03, 0], atol=1e-12)
    places = {(round(1000 * peg.position[0]), round(1000 * peg.position[1])) for peg in pegs}
    assert places == {(x, y) for x in (-80, -60, -40, 40, 60, 80) for y in (-30, 0, 30)} and len(pegs) == 18
    for peg in pegs:
        assert peg.size[0] == 0.0018 and peg.position[2] + peg.size[1] + peg.size[0] == pytest.approx(0.02)
    for peg, (position, _) in zip(pegs, board.sites.values(), strict=True):
        np.testing.assert_allclose(peg.position[:2], position[:2], atol=1e-12)


def test_the_board_of_surrol_has_its_twelve_pegs() -> None:
    plate, *pegs = load_object("peg_board_surrol").shapes
    np.testing.assert_allclose(2 * plate.size, [0.103, 0.154, 0.022])
    places = {(round(1e4 * peg.position[0]), round(1e4 * peg.position[1])) for peg in pegs}
    hexagon = {(-330, -270), (130, -270), (-215, -71), (15, -71), (-215, -469), (15, -469)}
    assert places == hexagon | {(x, y) for x in (-300, -100, 100) for y in (430, 130)}
    assert all(peg.position[2] + peg.size[1] + peg.size[0] == pytest.approx(0.026) for peg in pegs)


def test_a_peg_passes_through_the_block() -> None:
    block = load_object("block")
    points = ends(block)
    low, high = (points.min((0, 1)), points.max((0, 1)))
    outside = 1000 * (high - low + 2 * block.shapes[0].size[0])
    np.testing.assert_allclose(outside, [16.2, 14.1, 15.0], atol=0.2)
    steps = np.linspace(0, 1, 101)[:, None, None]
    along = points[:, 0] + steps * (points[:, 1] - points[:, 0])
    hole = (np.linalg.norm(along[..., :2], axis=-1) - block.shapes[0].size[0]).min()
    assert 1000 * hole == pytest.approx(4.5, abs=0.01) and 1000 * (hole - 0.0018) == pytest.approx(2.7, abs=0.01)


def test_the_ring_closes() -> None:
    ring = load_object("ring")
    points = ends(ring)
    np.testing.assert_allclose(points[-1, 1], points[0, 0], atol=1e-12)
    assert ring.mass == pytest.approx(1200 * 2 * math.pi**2 * 0.006 * 0.0015**2, rel=1e-9)
    np.testing.assert_allclose(ring.center, 0, atol=1e-12)


@pytest.mark.parametrize("name", RIGID)
def test_every_rigid_object_is_as_described(name: str) -> None:
    item = load_object(name)
    assert item.name == name and item.description and item.shapes and item.stiffness >= 2e4
    assert check(name) == []
    if item.free:
        moments = np.linalg.eigvalsh(item.inertia)
        assert 1e-5 < item.mass < 0.01 and moments[0] > 0 and moments[2] <= moments[0] + moments[1]
    else:
        assert item.mass == 0
    for shape in item.shapes:
        np.testing.assert_allclose(shape.rotation @ shape.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(shape.rotation) == pytest.approx(1)


def test_two_surfaces_make_a_contact() -> None:
    needle, pad = load_object("needle_sh").surface, load_object("pad").surface
    contact = needle.against(pad)
    assert contact == pad.against(needle)
    assert contact.sliding == pytest.approx(math.sqrt(0.8 * 0.5)) and contact.torsion == pytest.approx(math.sqrt(2e-6))
    assert 1 / contact.stiffness == pytest.approx(1 / 1e6 + 1 / 2e4)


# -- in scenes


@pytest.mark.parametrize("name", ["psm", "psm_si"])
def test_the_plates_of_a_jaw_meet_where_it_is_closed(name: str, tmp_path: Path) -> None:
    """At the lower stop the inner faces lie in one plane, the tool point on it; open, that point is outside."""
    path = tmp_path / "one.yaml"
    path.write_text(f"arms: {{{name}_0: {{arm: {name}}}}}\nobjects: {{pad: {{object: pad, position: [0, 0, -0.3]}}}}")
    scene = sm.load_scene(path)
    model, data, arm = scene.model, mujoco.MjData(scene.model), scene.mounts[f"{name}_0"].arm
    for opening in (arm.lower[-1], 0.3):
        assert arm.jaw is not None
        data.qpos[:] = scene.full_qpos({f"{name}_0": np.array([*arm.home[:-1], opening])})
        mujoco.mj_kinematics(model, data)
        wrist = data.body(f"{name}_0/wrist_yaw_link")
        axes = wrist.xmat.reshape(3, 3)
        tip = axes.T @ (data.site(f"{name}_0/tool_tip").xpos - wrist.xpos)
        np.testing.assert_allclose(tip, [0, 0, -0.0102], atol=1e-9)
        pads = np.flatnonzero(model.geom_group == PAD_GROUP)
        assert len(pads) == len(arm.jaw.pads) == 2
        for pad, side in zip(pads, (-1, 1), strict=True):
            signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
            place = data.geom_xmat[pad].reshape(3, 3)
            corners = (signs * model.geom_size[pad] @ place.T + data.geom_xpos[pad] - wrist.xpos) @ axes
            if opening == arm.lower[-1]:
                inner = np.sort(side * corners[:, 0])[:4]
                np.testing.assert_allclose(inner, 0, atol=1e-9)
                np.testing.assert_allclose(np.ptp(corners, axis=0), [0.0012, 0.0048, 0.00965], atol=1e-9)
                assert corners[:, 2].min() == pytest.approx(-0.0106)
            local = place.T @ (data.site(f"{name}_0/tool_tip").xpos - data.geom_xpos[pad])
            past = np.abs(local) - model.geom_size[pad]
            assert past.max() > (0.002 if opening == 0.3 else -1e-9)


def test_only_scenes_with_objects_have_plates() -> None:
    """So that the models of all others stay what they were."""
    for name in sm.list_scenes():
        scene = sm.load_scene(name)
        jaws = any(mount.arm.jaw and mount.arm.jaw.pads for mount in scene.mounts.values())
        assert (scene.model.geom_group == PAD_GROUP).any() == (jaws and bool(scene.placements))


@pytest.mark.parametrize("name", WITH_OBJECTS)
def test_a_free_object_is_a_mocap_body_and_qpos_that_of_the_arms(name: str) -> None:
    scene = sm.load_scene(name)
    model, data = scene.model, mujoco.MjData(scene.model)
    mujoco.mj_kinematics(model, data)
    assert model.nq == model.nv == sum(len(mount.arm.joints) for mount in scene.mounts.values())
    for body, place in scene.objects.items():
        ours = model.body(body)
        assert (ours.mocapid[0] >= 0) == place.object.free and ours.weldid[0] in (0, ours.id)
        np.testing.assert_allclose(data.body(body).xpos, place.position)
        np.testing.assert_allclose(data.body(body).xmat.reshape(3, 3), place.rotation, atol=1e-12)
        geoms = [model.geom(f"{body}/{number}") for number in range(len(place.object.shapes))]
        assert model.body_geomnum[ours.id] == len(geoms)
        for geom, shape in zip(geoms, place.object.shapes, strict=True):
            np.testing.assert_allclose(geom.pos, shape.position)
            np.testing.assert_allclose(matrix_of(geom.quat), shape.rotation, atol=1e-9)
            np.testing.assert_allclose(geom.rgba[:3], shape.colour, atol=1e-6)
            assert geom.group[0] == 1 and geom.contype[0] == geom.conaffinity[0] == 0


@pytest.mark.parametrize("name", [name for name in WITH_OBJECTS if name.endswith("_needle")])
def test_tools_reach_the_pad(name: str) -> None:
    """10 mm above its middle and 30 mm around, pointing down, whichever way the jaw opens."""
    scene = sm.load_scene(name)
    top = scene.objects["pad"].position
    for mount in scene.mounts.values():
        if mount.arm.jaw is None:
            continue
        for x, y, angle in [(x, y, a) for x in (-0.03, 0, 0.03) for y in (-0.03, 0, 0.03) for a in (0, 1, 2, 3)]:
            side, down = np.array([np.cos(angle * np.pi / 4), np.sin(angle * np.pi / 4), 0]), np.array([0, 0, -1.0])
            pose = np.eye(4)
            pose[:3, :3] = mount.rotation.T @ np.stack([side, np.cross(down, side), down], 1)
            pose[:3, 3] = mount.rotation.T @ (top + np.array([x, y, 0.01]) - mount.position)
            q = inverse_kinematics(mount.arm, pose)
            np.testing.assert_allclose(mount.arm.forward_kinematics(q), pose, atol=1e-4)
            angles = [i for i, joint in enumerate(mount.arm.actuated) if not joint.slides][:-1]
            assert np.minimum(q - mount.arm.lower, mount.arm.upper - q)[angles].min() > 0.5


@pytest.mark.parametrize("name", [name for name in WITH_OBJECTS if "ecm" in name])
def test_the_ecm_sees_tips_and_free_objects_from_its_home(name: str) -> None:
    scene = sm.load_scene(name)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_kinematics(scene.model, data)
    mujoco.mj_camlight(scene.model, data)
    eye = data.camera("ecm_0/left")
    half = np.tan(np.radians(scene.model.camera("ecm_0/left").fovy[0]) / 2)
    wanted = [data.site(f"{agent}/tool_tip").xpos for agent in scene.agents if agent != "ecm_0"]
    wanted += [place.position for place in scene.objects.values() if place.object.free]
    for point in wanted:
        x, y, z = eye.xmat.reshape(3, 3).T @ (point - eye.xpos)
        assert z < 0 and abs(y / z) < half and abs(x / z) < half * 4 / 3


def test_the_endoscope_sees_a_needle_and_names_it() -> None:
    skip_where_warp_lacks("cpu")
    scene = sm.load_scene("trimanual_psm_ecm_needle")
    endoscope = Endoscope(scene, width=128, height=128, channels=("segmentation",))
    seen = endoscope.labels[endoscope.render(scene.home[None].astype(np.float32)).segmentation]
    names = endoscope.label_names
    assert set(scene.objects) <= set(names) and (seen == names.index("needle")).any()


def test_a_colour_in_the_scene_replaces_the_files_own(tmp_path: Path) -> None:
    scene = sm.load_scene("bimanual_psm_pegs")
    blue, red = (scene.objects[f"block_{colour}"].object for colour in ("blue", "red"))
    assert blue.shapes[0].colour[2] > 0.5 > blue.shapes[0].colour[0] and blue.content != red.content
    assert np.array_equal(blue.inertia, red.inertia)


# -- files of one's own


@pytest.fixture
def own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's files in an empty folder, which is the working folder."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "clip.yaml").write_text(FILE)
    (tmp_path / "clip_on_pad.yaml").write_text(SCENE)
    return tmp_path


def test_the_page_makes_an_object_of_ones_own(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for line in re.findall(r"surgical-marl check .*", PAGE)[:2]:
        command, _, said = line.partition("#")
        assert main(command.split()[1:]) == 0
        assert capsys.readouterr().out == said.strip() + "\n"
    assert main(["export", "scene", "clip_on_pad.yaml"]) == 0
    model = mujoco.MjModel.from_xml_path("clip_on_pad.xml")
    assert model.joint("clip").type[0] == mujoco.mjtJoint.mjJNT_FREE
    names: dict[str, Any] = {}
    exec(CODE, names)
    assert names["clip"].shapes[0].colour == (0.2, 0.6, 0.9)
    assert capsys.readouterr().out.splitlines()[-1].startswith("71 mg, centre of mass at [")


def test_lists_name_objects(capsys: pytest.CaptureFixture[str]) -> None:
    assert sm.list_objects() == sorted(path.stem for path in content_dir("objects").glob("*.yaml"))
    assert main(["list", "objects"]) == 0
    assert capsys.readouterr().out.split() == sm.list_objects()
    assert main(["list", "objects", "-v"]) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert all(load_object(name).description in said for name in sm.list_objects())


ARC = "arc: {radius: 0.0015, degrees: 180.0, wire: 0.001, segments: 4, tilt: [0.0, 0.0, 90.0]}"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("density: 4500.0", "", "a free object needs either its mass"),
        ("density: 4500.0", "density: 4500.0\nmass: 1", "a free object needs either its mass"),
        ("density: 4500.0", "density: 0", "density must be a number from 1e-12 to .* .kg/m3., not 0"),
        ("density: 4500.0", "mass: -1", "mass must be a number from 1e-12 to .* .kg., not -1"),
        ("density: 4500.0", "mass: .nan", "mass must be a number from 1e-12 to .* .kg., not nan"),
        ("free: true", "free: false", "a fixed object has no density"),
        ("free: true", "free: maybe", "free must be true or false, not 'maybe'"),
        ("free: true", "", "clip.yaml lacks free"),
        ("shapes:", "forms: []\nshapes:", "unknown key 'forms'"),
        (FILE[FILE.index("shapes:") : FILE.index("sites:")], "shapes: []\n", "shapes must hold one or more shapes"),
        (FILE[FILE.index("shapes:") : FILE.index("sites:")], "", "lacks shapes"),
        ("sliding: 0.6", "sliding: -0.6", "friction.sliding must be a number from 0 to .*, not -0.6"),
        ("torsion: 0.001", "", "friction lacks torsion"),
        ("stiffness: 5.0e+5", "stiffness: 0", "stiffness must be a number from 1e-12 to .* .N/m., not 0"),
        (ARC, "mesh: {file: clip.stl}", "shapes.2: unknown key 'mesh'; the keys are capsule, sphere, box, plane, arc"),
        (ARC, "cylinder: {radius: 1}", "'cylinder'"),
        (ARC, "plane: {}", "a plane has no end"),
        (ARC, "box: {size: [0.001, 0.001, 0.001]}", "a box can't be part of a free object"),
        (ARC, "capsule", "shapes.2 must be a mapping of capsule, sphere, box, plane, arc, not 'capsule'"),
        (ARC, "sphere: {radius: 0}", "shapes.2.sphere.radius must be a number from 1e-06 to .*, not 0"),
        (ARC, "sphere: {radius: .inf}", "radius must be a number from 1e-06 to .*, not inf"),
        (ARC, "sphere: {}", "shapes.2.sphere lacks radius"),
        (
            ARC,
            "box: {size: [1, 0, 1]}",
            "size must be a list of three finite numbers, each from 1e-06 to 1,000 .m., not",
        ),
        (ARC, "box: {size: [1, 1]}", "three finite numbers"),
        (ARC, "box: {size: [1, 1, 1], tilt: [0, .nan, 0]}", "three finite numbers"),
        (ARC, "box: {size: [1, 1, 1], turn: 3}", "unknown key 'turn'"),
        (ARC, "capsule: {radius: 0.1, from: [0, 0, 0], to: [0, 0, 0]}", "from and to are the same point"),
        ("segments: 4", "segments: 0", "segments must be a whole number from 1 to 360, not 0"),
        ("degrees: 180.0", "degrees: 400", "degrees must be a number from 1e-06 to 360, not 400"),
        ("wire: 0.001", "wire: 0.1", "the wire thinner than the arc"),
        ("colour: [0.75, 0.75, 0.80]", "colour: [2, 0, 0]", "colour .* each from 0 to 1"),
        (
            "material: steel",
            "material: stel",
            "material must be one of steel, paint, plastic, rubber, cloth, tissue, not 'stel'",
        ),
        ("material: steel", "material: [steel]", "material must be one of steel, .*, not .'steel'."),
        (ARC, "sphere: {radius: 0.001, material: 3}", "shapes.2.sphere.material must be one of steel, .*, not 3"),
        ("  grasp: {position", "  grasp: {positon", "sites.grasp: unknown key 'positon'"),
    ],
)
def test_a_wrong_file_is_one_sentence(
    own: Path, capsys: pytest.CaptureFixture[str], old: str, new: str, words: str
) -> None:
    assert old in FILE
    (own / "clip.yaml").write_text(FILE.replace(old, new))
    for source in ("clip.yaml", "clip_on_pad.yaml"):
        assert main(["check", source]) == 1
        said = capsys.readouterr().out
        assert said.count("\n") == 1 and re.search(words, said), said
    assert main(["export", "scene", "clip_on_pad.yaml"]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and re.search(words, said), said


CLIP = "object: clip.yaml, position: [0.02, 0.0, 0.0205]"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("object: pad", "object: pda", "unknown object 'pda', did you mean 'pad'"),
        ("object: clip.yaml", "object: clop.yaml", "unknown object 'clop.yaml'"),
        ("object: pad", "objct: pad", "unknown key 'objct'"),
        ("object: pad", "object: pad, mass: 3", "unknown key 'mass'"),
        ("  clip:", "  psm_0:", "psm_0 is taken"),
        ("  clip:", "  my/clip:", "letters, digits and underscores"),
        (CLIP, CLIP.replace("0.0205", "0.0202"), "'pad/0' and 'clip/.' overlap at the start by 0.3 mm"),
        (CLIP, CLIP.replace("[0.02, 0.0, 0.0205]", "[0, 0, 0.0463]"), "'psm_0/.*' and 'clip/.' overlap at the start"),
        ("[0.0, 0.0, 0.02]", "[0.0, 0.0, 0.05]", "'psm_0/.*' and 'pad/0' overlap at the start"),
        ("[0.02, 0.0, 0.0205]", "[0.02, .nan, 0.0205]", "three finite numbers"),
        ("[0.2, 0.6, 0.9]", "[0.2, 0.6, 9]", "colour .* each from 0 to 1"),
        ("objects:", "objects: 3\nview:", "must be a mapping"),
    ],
)
def test_a_wrong_place_is_one_sentence(own: Path, old: str, new: str, words: str) -> None:
    assert old in SCENE
    (own / "clip_on_pad.yaml").write_text(SCENE.replace(old, new))
    with pytest.raises(ValueError, match=words) as caught:
        sm.load_scene("clip_on_pad.yaml")
    assert "\n" not in str(caught.value)


def test_two_free_objects_may_not_overlap(own: Path) -> None:
    (own / "clip_on_pad.yaml").write_text(SCENE + "  other: {object: clip.yaml, position: [0.021, 0.0, 0.0205]}\n")
    with pytest.raises(ValueError, match=r"'clip/.' and 'other/.' overlap at the start"):
        sm.load_scene("clip_on_pad.yaml")


def test_a_change_of_an_object_changes_the_scene(own: Path) -> None:
    """Or else the model with the old object would come from the cache."""
    before = sm.load_scene("clip_on_pad.yaml").model.geom("clip/0").size[0]
    (own / "clip.yaml").write_text(FILE.replace("radius: 0.0005", "radius: 0.0004"))
    assert sm.load_scene("clip_on_pad.yaml").model.geom("clip/0").size[0] == pytest.approx(0.0004) != before


def test_mass_and_density_are_two_ways_to_say_the_same(own: Path) -> None:
    one = load_object("clip.yaml")
    (own / "clip.yaml").write_text(FILE.replace("density: 4500.0", f"mass: {one.mass!r}"))
    other = load_object("clip.yaml")
    np.testing.assert_allclose(other.inertia, one.inertia, rtol=1e-9)
    assert other.mass == one.mass
