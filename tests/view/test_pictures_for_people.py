"""Pictures for people: shapes against C MuJoCo's rays, shadows, materials, and a view in which little is hidden."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

import surgical_marl as sm
from surgical_marl.envs.env import Env
from surgical_marl.robots.rotation import turned
from surgical_marl.robots.spec import VISUAL_GROUP
from surgical_marl.scenes.objects import load_object
from surgical_marl.scenes.scene import Scene
from surgical_marl.scenes.shapes import MATERIALS
from surgical_marl.view.camera import Focus, best_view, seen
from surgical_marl.view.render import Renderer, View
from surgical_marl.view.shading import AGENTS, GAMMA, LOOKS, RUBBER, STEEL, TEAM, goal_colour, material, materials
from surgical_marl.view.stage import TABLE, paint, stage
from surgical_marl.vision.endoscope import Endoscope
from tests.scenes.test_objects import FILE, SCENE

SIZE = 96
KINDS = ("sphere", "ellipsoid", "capsule", "cylinder", "box", "mesh")
TETRAHEDRON = "<asset><mesh name='solid' vertex='0 0 .2  .2 0 -.1  -.1 .2 -.1  -.1 -.2 -.1'/></asset>"


def posed(xml: str) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{xml}</mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def at_home(scene: Scene) -> mujoco.MjData:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = scene.home
    mujoco.mj_forward(scene.model, data)
    return data


@pytest.mark.parametrize("kind", KINDS)
def test_shapes_cover_the_pixels_that_rays_of_mujoco_hit(kind: str) -> None:
    rng = np.random.default_rng(KINDS.index(kind))
    shape = "mesh='solid'" if kind == "mesh" else "size='.12 .2 .07'"
    places = [(rng.uniform(-0.3, 0.3, 3), rng.uniform(-180, 180, 3)) for _ in range(4)]
    geoms = [
        f"<geom type='{kind}' {shape} pos='{' '.join(map(str, place))}' euler='{' '.join(map(str, angles))}'/>"
        for place, angles in places
    ]
    model, data = posed(f"{TETRAHEDRON}<worldbody>{''.join(geoms)}</worldbody>")
    view = View(distance=1.6, azimuth=30.0, elevation=-35.0, fovy=50.0)
    empty = posed("<statistic center='0 0 0' extent='1'/>")
    drawn = Renderer(model, SIZE, SIZE).render(data, view).astype(int)
    covered = np.abs(drawn - Renderer(empty[0], SIZE, SIZE).render(empty[1], view)).sum(-1) > 6

    eye, axes = view.pose()
    side = np.tan(np.radians(25.0)) * (2 * (np.arange(SIZE) + 0.5) / SIZE - 1)
    rays = np.stack([*np.meshgrid(side, -side), np.full((SIZE, SIZE), -1.0)], -1) @ axes.T
    hit = np.array(
        [mujoco.mj_ray(model, data, eye, ray, None, 1, -1, np.zeros(1, np.int32)) for ray in rays.reshape(-1, 3)]
    )
    expected = (hit >= 0).reshape(SIZE, SIZE)
    edge = np.zeros_like(expected)  # where finer rays mix what is beside
    for axis in (0, 1):
        for step in (-1, 1):
            edge |= np.roll(expected, step, axis) != expected
    assert expected.mean() > 0.05
    assert (covered == expected)[~edge].mean() > 0.998


def test_an_eye_inside_a_shape_looks_out_of_it() -> None:
    """As a scope that is drawn back looks out of its sleeve."""
    ball = "<geom size='.05' pos='0 .5 0' rgba='1 0 0 1'/>"
    model, data = posed(f"<worldbody>{ball}<geom type='cylinder' size='.2 .2' rgba='0 0 1 1'/></worldbody>")
    seen = Renderer(model, 41, 31).render(data, View(lookat=(0, 0.1, 0), distance=0.1, elevation=0)).astype(int)
    assert seen[15, 20, 0] > 2 * seen[15, 20, 2]


def half_shadow(height: float) -> int:
    """Return over how many pixels a shadow ends, on the right of a board so high above a floor."""
    floor = "<geom type='plane' size='0 0 1' rgba='.8 .8 .8 1'/>"
    board = f"<geom type='box' size='.2 .2 .005' pos='0 0 {height}' rgba='.1 .1 .1 1'/>"
    model, data = posed(f"<statistic center='0 0 0' extent='1'/><worldbody>{floor}{board}</worldbody>")
    view = View(distance=1.0, azimuth=90.0, elevation=-89.99, lookat=(0.3, 0.05, 0.0))
    row = Renderer(model, 300, 300).render(data, view)[150].astype(float).sum(-1)
    return int(((row > 0.73 * row[-1]) & (row < 0.98 * row[-1])).sum())  # the shadow itself and the board are darker


def test_shadows_are_softer_the_farther_they_fall() -> None:
    near, far = half_shadow(0.06), half_shadow(0.3)
    assert 0 < 4 * near < far


def test_what_stands_on_a_floor_darkens_it_nearby() -> None:
    floor = "<geom type='plane' size='0 0 1' rgba='.8 .8 .8 1'/>"
    view = View(distance=1.0, elevation=-89.0)
    plain, standing = (
        Renderer(model, 100, 100).render(data, view).astype(int).sum(-1)
        for model, data in (
            posed(f"<statistic center='0 0 0' extent='1'/><worldbody>{floor}{more}</worldbody>")
            for more in ("", "<geom type='box' size='.1 .1 .2' pos='0 0 .2'/>")
        )
    )
    darker = plain - standing
    lamp_side = darker[60:80, 20:30]  # the lamp is on the left, towards the viewer: no shadow falls here
    assert 0 <= np.abs(darker[90:, :10]).max() <= 6
    assert lamp_side.mean() > 6


def test_a_needle_is_a_line_from_afar() -> None:
    model, data = posed(
        "<worldbody><geom type='capsule' fromto='-.3 0 0 .3 0 .02' size='.0004' rgba='1 0 0 1'/></worldbody>"
    )
    drawn = Renderer(model, 120, 90).render(data, View(distance=2.0, elevation=0)).astype(int)
    red = (drawn[..., 0] - drawn[..., 2] > 20).any(0)
    assert red[np.argmax(red) : len(red) - np.argmax(red[::-1])].all() and red.sum() > 30


def test_a_hidden_goal_is_seen_through_what_hides_it() -> None:
    model, data = posed("<worldbody><geom size='.1' rgba='.2 .2 .2 1'/></worldbody>")
    goal = [((0.0, 0.3, 0.0), 0.05, (0.0, 1.0, 0.0, 1.0))]
    front, renderer = View(elevation=0.0), Renderer(model, 60, 60)
    hidden, shown = (renderer.render(data, front, goal, through)[30, 30].astype(int) for through in (0.0, 0.5))
    assert shown[1] > hidden[1] + 30 and shown[1] > 1.3 * shown[0]


def test_colours_say_what_things_are_made_of() -> None:
    scene = sm.load_scene("ecm")
    made = dict(
        zip((scene.model.geom(geom).name for geom in range(scene.model.ngeom)), materials(scene.model), strict=True)
    )
    tissue, gauze = made["tissue/liver"], made["tissue/gauze"]
    assert made["field"].pattern == tissue.pattern != gauze.pattern
    shaft = [
        found for geom, found in enumerate(materials(scene.model)) if np.allclose(scene.model.geom_size[geom][0], 0.006)
    ]
    assert shaft and shaft[0].gloss[2] == 1.0  # bare steel


def test_a_geom_may_be_painted_with_a_colour_or_a_material() -> None:
    model, data = posed("<worldbody><geom size='.1' rgba='.2 .2 .2 1'/></worldbody>")
    front, green = View(elevation=0.0), (0.1, 0.8, 0.1)
    plain, colour, made = (
        Renderer(model, 60, 60, paint=paint).render(data, front)[30, 30].astype(int)
        for paint in ({}, {0: green}, {0: material(np.array(green))})
    )
    assert plain[1] < 1.3 * plain[0] and (colour == made).all() and colour[1] > 2 * colour[0]


def test_every_material_has_a_look_of_its_own() -> None:
    assert set(LOOKS) == set(MATERIALS) and len(set(LOOKS.values())) == len(MATERIALS)


def test_an_object_looks_as_its_file_says_and_otherwise_as_its_colour_suggests(tmp_path: Path) -> None:
    """The endoscope's pictures are the same in any case."""
    file = "{free: false, friction: {sliding: 1, torsion: 0}, stiffness: 1.0e+5, %s shapes: [%s, %s]}"
    ball, stick = "sphere: {radius: 0.02", "capsule: {radius: 0.002, from: [0.03, 0, 0], to: [0.03, 0, 0.03]"
    (tmp_path / "one.yaml").write_text(
        "arms: {ecm_0: {arm: ecm, position: [0, 0, 0.3]}}\nobjects: {it: {object: it.yaml, position: [0, 0, 0.06]}}"
    )
    drawn, observed = [], []
    for of_all, own in (("", ""), ("material: steel,", ""), ("material: steel,", ", material: rubber")):
        (tmp_path / "it.yaml").write_text(file % (of_all, f"{{{ball}}}}}", f"{{{stick}{own}}}}}"))
        scene = sm.load_scene(tmp_path / "one.yaml")
        sphere, capsule = (scene.model.geom(f"it/{number}").id for number in (0, 1))
        named = paint(scene)
        found = [named[geom].gloss if geom in named else None for geom in (sphere, capsule)]
        assert found == [STEEL if of_all else None, RUBBER if own else STEEL if of_all else None]
        view = View((0, 0, 0.06), 0.1, elevation=-10)
        drawn.append(Renderer(scene.model, 60, 60, stage(scene), named).render(at_home(scene), view).astype(int))
        observed.append(Endoscope(scene).render(scene.home[None]).rgb)
    assert np.abs(drawn[1] - drawn[2]).max() > 8
    assert all(np.array_equal(one, observed[0]) for one in observed)


def test_a_material_is_no_part_of_what_is_compiled(tmp_path: Path) -> None:
    """Files that differ in materials alone have the same keys of caches, and give the same model."""
    text, made = FILE + "# end", []
    variants = (text.replace("material: steel", ""), text, text.replace("0.0], to", "0.0], material: cloth, to", 1))
    assert len(set(variants)) == 3
    for number, variant in enumerate(variants):
        folder = tmp_path / str(number)
        folder.mkdir()
        (folder / "clip.yaml").write_text(variant)
        (folder / "clip_on_pad.yaml").write_text(SCENE)
        item = load_object(folder / "clip.yaml")
        env = Env("reach", str(folder / "clip_on_pad.yaml"))
        made.append((item.content, env.content, *(shape.material for shape in item.shapes[:2])))
    contents, envs, first, second = zip(*made, strict=True)
    assert len(set(contents)) == len(set(envs)) == 1
    assert first == ("", "steel", "cloth") and second == ("", "steel", "steel")
    heavier = tmp_path / "clip.yaml"
    heavier.write_text(text.replace("density: 4500.0", "density: 4600.0"))
    assert load_object(heavier).content != contents[0]


def test_goals_have_the_colour_of_the_arm_that_goes_there() -> None:
    scene = sm.load_scene("trimanual_psm_ecm")
    painted = paint(scene)
    for number, agent in enumerate(scene.agents):
        assert goal_colour(number, 3, 3) == AGENTS[number]
        made = painted[scene.model.geom(f"{agent}_trocar").id]
        np.testing.assert_allclose(made.colour ** (1 / GAMMA), AGENTS[number])
    assert goal_colour(0, 1, 2) == TEAM and goal_colour(0, 1, 1) == AGENTS[0]


def test_an_endoscope_sees_nothing_of_the_stage_or_the_paint() -> None:
    """What agents observe is drawn from the scene alone: a stage adds no geom to it."""
    scene = sm.load_scene("ecm")
    before = Endoscope(scene).render(scene.home[None]).rgb
    count = scene.model.ngeom
    Renderer(scene.model, 40, 30, stage(scene), paint(scene)).render(at_home(scene))
    assert scene.model.ngeom == count
    np.testing.assert_array_equal(Endoscope(scene).render(scene.home[None]).rgb, before)


@pytest.mark.parametrize(
    "name",
    [
        "psm",
        "bimanual_star",
        "trimanual_psm_ecm",
        "bimanual_psm_needle",
        "trimanual_psm_ecm_pegs",
        "bimanual_psm_tissue",
        "psm_suture",
    ],
)
def test_no_arm_hides_what_matters(name: str) -> None:
    scene = sm.load_scene(name)
    data, view = at_home(scene), best_view(scene)
    assert view == best_view(scene)
    tips = np.array([data.site(f"{agent}/tool_tip").xpos for agent in scene.agents])
    objects = [scene.model.body(free).pos for free in scene.free_objects]
    points = np.array([*tips, *objects])
    eye, axes = view.pose()
    assert seen(scene.model, data, eye, points).all()
    points = np.concatenate([points, *(bars.start for bars in scene.drawn.values())])
    local = (points - eye) @ axes
    assert (np.abs(local[:, :2] / -local[:, 2:]) < np.tan(np.radians(view.fovy / 2)) * np.array([4 / 3, 1])).all()


@pytest.mark.parametrize("name", ["psm_suture", "bimanual_star", "trimanual_psm_ecm"])
def test_a_view_of_the_whole_holds_all_arms_and_their_work(name: str) -> None:
    scene = sm.load_scene(name)
    view, data, model = best_view(scene, aspect=1.0, whole=True), at_home(scene), scene.model
    eye, axes = view.pose()
    arms = np.flatnonzero([model.body(int(body)).name.partition("/")[0] in scene.agents for body in model.geom_bodyid])
    shown = arms[model.geom_group[arms] == VISUAL_GROUP]
    points = np.concatenate([data.geom_xpos[shown], [data.site(f"{agent}/tool_tip").xpos for agent in scene.agents]])
    across, up, back = ((points - eye) @ axes).T
    side = np.tan(np.radians(view.fovy / 2))
    assert (np.abs(across / back).max() < side) and np.abs(up / back).max() < side and (back < 0).all()
    assert max(np.ptp(across / back), np.ptp(up / back)) > 0.5 * side  # and they are not small


@pytest.mark.parametrize(
    "name, what",
    [("psm_suture", "needle"), ("psm_needle", "needle"), ("bimanual_psm_tissue", "flap"), ("psm", "psm_0")],
)
def test_a_view_from_near_follows_what_a_scene_is_about(name: str, what: str) -> None:
    scene = sm.load_scene(name)
    data, model = at_home(scene), scene.model
    follows = Focus(scene, best_view(scene))
    owners = np.array([model.body(int(body)).name.partition("/")[0] for body in model.geom_bodyid])
    own = data.geom_xpos[owners == what]
    if what in scene.agents:
        own = data.site(f"{what}/tool_tip").xpos[None]
    view = follows(data)
    assert (own.min(0) - 1e-9 <= view.lookat).all() and (own.max(0) + 1e-9 >= view.lookat).all()
    half = view.distance * np.tan(np.radians(view.fovy / 2))
    assert 0.02 <= half < 0.05
    data.geom_xpos[owners == what] += 0.1
    data.site_xpos[:] += 0.1
    np.testing.assert_allclose(np.array(follows(data).lookat) - view.lookat, 0.1)


def test_what_is_behind_something_is_not_seen() -> None:
    model, data = posed("<worldbody><geom size='.1'/></worldbody>")
    points = np.array([[0.0, 0.5, 0.0], [0.0, 0.5, 0.4], [0.0, -0.1, 0.0]])
    assert seen(model, data, np.array([0.0, -1.0, 0.0]), points).tolist() == [False, True, True]


def test_boards_that_hang_in_the_air_get_a_stand() -> None:
    scene = sm.load_scene("psm_needle")
    bare = stage(sm.load_scene("psm"))
    stands = stage(scene)[len(bare) :]
    assert len(stands) == 1
    stand, pad = stands[0], at_home(scene).geom("pad/0")
    np.testing.assert_allclose(stand.axes, turned(np.array([0.0, 0.0, 90.0])), atol=1e-9)  # as the pad is
    assert stand.place[2] - stand.size[2] == pytest.approx(TABLE)
    assert stand.place[2] + stand.size[2] == pytest.approx(pad.xpos[2] - scene.model.geom("pad/0").size[2])
