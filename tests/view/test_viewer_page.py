"""The viewer's page: who may open it, and what its controls do, without a browser."""

from __future__ import annotations

import http.client
import io
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.parse import urlsplit

import mujoco
import numpy as np
import pytest
import trimesh

pytest.importorskip("viser", reason="the viewer's page needs viser: pip install 'surgical-marl[view]'")

import viser
import websockets.asyncio.server
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from surgical_marl.bench import page
from surgical_marl.cli.main import main
from surgical_marl.content import find
from surgical_marl.engines.compilation import compiling
from surgical_marl.runs.settings import Settings
from surgical_marl.scenes.load import load_scene
from surgical_marl.view.browser.nodes import distance_colour, offsets, segments
from surgical_marl.view.browser.panel import Choice
from surgical_marl.view.browser.pictures import observed
from surgical_marl.view.browser.plots import Plots, curves
from surgical_marl.view.browser.server import close_server, open_server, unlocked
from surgical_marl.view.browser.shapes import body_glb, geom_mesh
from surgical_marl.view.browser.viewer import Viewer
from surgical_marl.view.history import History, reported
from surgical_marl.view.lighting import PLAIN
from surgical_marl.view.session import Session
from surgical_marl.view.shading import CLOTH, LOOKS, WET, Material


@pytest.fixture(scope="module")
def address() -> Iterator[str]:
    serve = websockets.asyncio.server.serve
    server, found = open_server(0)
    assert websockets.asyncio.server.serve is serve
    yield found
    close_server(server)


def fetched(address: str, path: str, **headers: str) -> tuple[int, bytes]:
    parts = urlsplit(address)
    connection = http.client.HTTPConnection(str(parts.hostname), parts.port, timeout=10)
    connection.request("GET", path, headers=headers)
    response = connection.getresponse()
    return response.status, response.read()


def answer(address: str, path: str) -> int:
    return fetched(address, path)[0]


def test_a_page_needs_its_secret(address: str) -> None:
    secret = urlsplit(address).path
    assert answer(address, secret) == 200
    for path in ("/", "/index.html", secret[:-2] + "/", secret.upper(), "/x" + secret, f"/?{secret}", "/%00"):
        assert answer(address, path) == 403, path


@pytest.mark.parametrize("up", ["../", "%2e%2e/", "..%2f", "%2e%2e%2f", "..\\", "....//", "%252e%252e/", "/", ""])
def test_no_file_outside_of_the_page_is_served(address: str, up: str) -> None:
    secret = urlsplit(address).path
    page = Path(viser.__file__).parent / "client" / "build"
    for path in (
        f"{up * 30}etc/passwd",
        f"{up * 2}__init__.py",
        f"{up * 3}_version.py",
        f"{page.parent.parent}/infra.py",
    ):
        status, body = fetched(address, f"{secret}{path}")
        assert status in (403, 404) or body == fetched(address, secret)[1], path


def test_another_name_of_this_machine_opens_nothing(address: str) -> None:
    """A site whose name leads to 127.0.0.1 does not know the secret, whatever its browser says."""
    for name in ("evil.example", "localhost.evil.example:80", "127.0.0.1"):
        assert fetched(address, "/", Host=name, Origin=f"http://{name}")[0] == 403


def test_a_websocket_needs_its_secret(address: str) -> None:
    protocol: Any = f"viser-v{viser.__version__}"
    for path in ("/", "/wrong"):
        with pytest.raises(InvalidStatus, match="403"):
            connect(f"ws://{urlsplit(address).netloc}{path}", subprotocols=[protocol])
    with connect(address.replace("http", "ws").rstrip("/"), subprotocols=[protocol]) as socket:
        assert socket.recv(timeout=10)


def test_addresses_are_random_and_local(address: str) -> None:
    server, other = open_server(0)
    close_server(server)
    assert urlsplit(address).hostname == urlsplit(other).hostname == "127.0.0.1"
    assert urlsplit(address).path != urlsplit(other).path
    assert len(urlsplit(other).path) > 30


def test_a_port_in_use_is_refused(
    address: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    port = urlsplit(address).port
    assert port
    with pytest.raises(ValueError, match=f"cannot serve on port {port}.*--port"):
        open_server(port)
    monkeypatch.setattr("surgical_marl.view.browser.viewer.Viewer", None)  # the command says so before it makes one
    assert main(["view", "reach", "--scene", "psm", "--port", str(port)]) == 2
    assert f"cannot serve on port {port}" in capsys.readouterr().err


def test_a_viser_that_serves_in_another_way_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other:
        def __init__(self, **_: Any) -> None:
            pass

        def stop(self) -> None:
            pass

    monkeypatch.setattr(viser, "ViserServer", Other)
    with pytest.raises(RuntimeError, match="without a guard"):
        open_server(0)


@pytest.mark.parametrize(
    "path, inside",
    [
        ("/key", "/"),
        ("/key/", "/"),
        ("/key/a/b?x=/", "/a/b"),
        ("/ke", None),
        ("", None),
        ("/keyy/", None),
        ("/\udce9/", None),
    ],
)
def test_the_secret_is_cut_off_a_path(path: str, inside: str | None) -> None:
    assert unlocked(path, "key") == inside


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    made = Viewer(Settings(task="reach", scene="bimanual_psm", seed=3), "oracle", port=0)
    yield made
    made.session.close()
    close_server(made.server)


def turn(viewer: Viewer, times: int = 1) -> None:
    for _ in range(times):
        viewer.turn(time.monotonic())


def test_what_is_drawn_is_where_it_is(viewer: Viewer) -> None:
    viewer.pace.paused = True
    for _ in range(10):
        viewer.pace.step_once()
        turn(viewer)
    moment = viewer.session.moment()
    nodes = viewer._nodes
    for body, handle in nodes._moving.items():
        np.testing.assert_allclose(handle.batched_positions, moment.positions[:, body], atol=1e-6)
        np.testing.assert_allclose(handle.batched_wxyzs, moment.quaternions[:, body], atol=1e-6)
    assert nodes._marks is not None
    np.testing.assert_allclose(nodes._marks.batched_positions, moment.marks[0], atol=1e-6)
    assert moment.nearest[0] is not None
    np.testing.assert_allclose(nodes._lines.points[0], moment.nearest[0].ends, atol=1e-6)


class Camera(SimpleNamespace):
    """As viser's: who moves it moves the point that it looks at too."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "position":
            self.__dict__["look_at"] = self.look_at + value - self.position
        self.__dict__[name] = value


def test_a_page_as_narrow_as_a_phones_looks_from_farther_away(viewer: Viewer) -> None:
    first = viewer.server.initial_camera
    away = np.asarray(first.position) - first.look_at
    for aspect, wider in ((0.5, 2.0), (1.5, 1.0)):
        begin = {"position": np.asarray(first.position), "look_at": np.asarray(first.look_at)}
        client: Any = SimpleNamespace(camera=Camera(aspect=aspect, **begin))
        viewer._stand_back(client)
        np.testing.assert_allclose(client.camera.position - first.look_at, wider * away, atol=1e-6)
        np.testing.assert_allclose(client.camera.look_at, first.look_at, atol=1e-6)


def test_what_can_not_be_done_changes_nothing(viewer: Viewer) -> None:
    session, who = viewer.session, dict(viewer.session.movers.who)
    viewer.ask(lambda: session.set_mover(session.env.agents[0], "nobody"))
    viewer.ask(lambda: viewer.choose(Choice("reach", "bimanual_psm", "no such level", 1, 100)))
    turn(viewer)
    assert viewer.session is session and session.movers.who == who


def test_other_environments_are_looked_at(viewer: Viewer) -> None:
    agents = viewer.session.env.agents
    viewer.ask(lambda: viewer.session.set_mover(agents[1], "frozen"))
    viewer.pace.speed, viewer.pace.paused = 0.25, True
    viewer.ask(lambda: viewer.choose(Choice("reach", "bimanual_psm", "default", 3, 40)))
    turn(viewer, 2)
    assert (viewer.pace.speed, viewer.pace.paused) == (0.25, True)
    env = viewer.session.env
    assert (env.num_envs, env.max_steps, viewer.session.settings.difficulty) == (3, 40, "default")
    assert viewer.session.movers.who == {agents[0]: "oracle", agents[1]: "frozen"}
    assert viewer.session.seed == 3


def test_the_page_says_what_a_compilation_is_at(viewer: Viewer, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []

    def make(*_: Any) -> None:
        with compiling("reach on psm") as stage:
            stage("tracing the step")
            raise ValueError("no such thing")

    monkeypatch.setattr("surgical_marl.view.browser.viewer.Session", make)
    monkeypatch.setattr(viewer, "_say", lambda title, text, seconds, **_: said.append(f"{title}, {text}"))
    with pytest.raises(ValueError, match="no such thing"):
        viewer.choose(Choice("reach", "bimanual_psm", "default", 2, 77))
    assert said == ["Preparing, reach on bimanual_psm", "Compiling, reach on psm: tracing the step",
                    "Compiling, reach on psm: failed"]  # fmt: skip


def test_every_visible_geom_has_a_surface_where_it_is() -> None:
    model = load_scene("trimanual_psm_ecm_pegs").model
    for geom in np.flatnonzero(model.geom_group <= 2):
        mesh = geom_mesh(model, int(geom))
        assert mesh is not None
        half = model.geom_aabb[geom, 3:]
        assert np.abs(mesh.vertices - model.geom_pos[geom]).max() <= np.linalg.norm(half) + 1e-6
        assert mesh.is_watertight or len(mesh.faces) > 0


def test_the_page_knows_what_things_are_made_of() -> None:
    steel, wet, cloth = (
        Material(np.array([0.2, 0.2, 0.2]), gloss, int(PLAIN)) for gloss in (LOOKS["steel"][0], WET, CLOTH)
    )
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><geom size='.1'/><geom size='.1' rgba='1 1 1 .5'/><geom size='.1'/></worldbody></mujoco>"
    )
    glb = body_glb(model, 0, [steel, wet, cloth])
    assert glb is not None
    made = [mesh.visual.material for mesh in trimesh.load_scene(io.BytesIO(glb), file_type="glb").geometry.values()]
    assert [one.metallicFactor > 0 for one in made] == [True, False, False]
    assert made[0].roughnessFactor == made[1].roughnessFactor < made[2].roughnessFactor
    assert [one.alphaMode for one in made] == ["OPAQUE", "BLEND", "OPAQUE"]
    np.testing.assert_allclose(made[0].baseColorFactor[:3] / 255, 0.2 ** (1 / 2.2), atol=1 / 255)


def test_distances_turn_red() -> None:
    assert distance_colour(0.0).tolist() == [226, 40, 40] == distance_colour(-0.01).tolist()
    far, near = distance_colour(0.1), distance_colour(0.005)
    assert near[0] > far[0] and near[1] < far[1]
    assert (distance_colour(0.03) == far).all()


def test_environments_stand_side_by_side() -> None:
    assert offsets(3, 2.0)[:, 0].tolist() == [2.0, 0.0, -2.0]
    assert not offsets(3, 2.0)[:, 1:].any()


def test_a_line_through_points_has_one_piece_less() -> None:
    points = np.arange(12.0).reshape(4, 3)
    assert segments(points).shape == (3, 2, 3)
    np.testing.assert_array_equal(segments(points)[1], points[1:3])


def test_plots_show_what_happened(viewer: Viewer) -> None:
    viewer.session.reset()
    for _ in range(4):
        viewer.session.step()
    agent = viewer.session.env.agents[0]
    plots = curves(viewer.session.history)
    assert {"error, mm", "distance of arms, mm", "reward", f"terms of the reward of {agent}"} <= plots.keys()
    (terms,) = (plots[title] for title in plots if title.endswith(f"of {agent}"))
    assert plots["error, mm"][0].values[-1] == pytest.approx(1000 * viewer.session.infos[agent]["tip_error"][0])
    total = np.sum([line.values for line in terms], axis=0)
    np.testing.assert_allclose(total, plots["reward"][0].values, atol=1e-5)


def test_plots_show_how_arms_grip_objects() -> None:
    """Two steps: the first arm presses and then holds, the second one has no jaw and so no such infos."""
    history = History(["psm_0", "ecm_0"], dt=0.5, objects=["block_red", "needle"])
    for force, holding, slip in ((2.0, False, 0.0), (3.0, True, 0.004)):
        infos = {
            "block_red_force": [force],
            "block_red_holding": [holding],
            "block_red_slip": [slip],
            "cost_force": [1],
        }
        history.add({"psm_0": {**infos, "contact_force": [9.0]}, "ecm_0": {}}, {"psm_0": [0.0], "ecm_0": [0.0]})
    assert history.names("psm_0") == [
        "block_red_force",
        "block_red_holding",
        "block_red_slip",
        "contact_force",
        "reward",
    ]
    plots = curves(history)
    force, held = plots["grip on block_red, N"]
    assert (force.label, held.label) == ("psm_0", "psm_0 holds") and force.colour == held.colour
    np.testing.assert_array_equal(force.values, [2.0, 3.0])
    np.testing.assert_array_equal(held.values, [0.0, 3.0])
    (slip,) = plots["slip of block_red, mm"]
    np.testing.assert_allclose(slip.values, [0.0, 4.0])
    assert not any("needle" in title for title in plots)


def test_plots_show_thread_and_tissue() -> None:
    scene = load_scene("bimanual_psm_suture")
    assert {"tension", "tissue_force"} <= {*reported(scene)} and len({*reported(scene)}) == len(reported(scene))
    history = History(scene.agents, dt=0.5, reports=reported(scene))
    for force in (0.0, 0.5):
        info = {key: [force] for key in reported(scene)}
        history.add(dict.fromkeys(scene.agents, info), {key: [0.0] for key in scene.agents})
    (line,) = curves(history)["tissue force"]
    np.testing.assert_array_equal(line.values, [0.0, 0.5])


def test_an_area_is_filled_while_an_arm_holds_an_object() -> None:
    drawn: list[Any] = []
    said = SimpleNamespace(visible=True)
    gui = SimpleNamespace(
        add_uplot=lambda data, series, **_: drawn.append((data, series)), add_markdown=lambda text: said
    )
    plots = Plots(SimpleNamespace(gui=gui), nullcontext())
    history = History(["psm_0"], dt=0.5, objects=["needle"])
    for force in (1.0, 2.0, 3.0):
        info = {"needle_force": [force], "needle_holding": [force > 1], "needle_slip": [0.0]}
        history.add({"psm_0": info}, {"psm_0": [0.0]})
    assert said.visible
    plots.draw(history)
    assert not said.visible
    data, (time_axis, force, held) = drawn[0]
    assert time_axis == {"label": "s"} and held["fill"].startswith(force["stroke"]) and "fill" not in force
    np.testing.assert_array_equal(data, [[-1.0, -0.5, 0.0], [1.0, 2.0, 3.0], [0.0, 2.0, 3.0]])


def test_forces_of_grips_are_those_of_the_engine() -> None:
    """An oracle picks a needle up: what is plotted is what the arrows show."""
    session = Session(Settings(task="needle_pick", scene="psm_needle", seed=1), "oracle")
    pressed = []
    for _ in range(60):
        session.step()
        pressed.append(session.env.grip_forces[0].sum())
    force, held = curves(session.history)["grip on needle, N"]
    np.testing.assert_allclose(force.values, pressed, rtol=1e-4, atol=1e-6)
    assert max(pressed) > 0 and 0 < (held.values > 0).sum() < len(pressed)
    session.close()


def test_pictures_that_agents_observe_are_shown() -> None:
    depth = np.full((2, 4, 4, 1), 0.125, np.float32)
    colours = np.arange(96, dtype=np.uint8).reshape(2, 4, 4, 3)
    seen = observed(
        {"ecm_0": {"proprioception": np.zeros((2, 3)), "depth": depth, "rgb": colours}, "psm_0": np.zeros(3)}
    )
    assert list(seen) == ["ecm_0 observes depth", "ecm_0 observes rgb"]
    assert (seen["ecm_0 observes depth"] == 127).all() and seen["ecm_0 observes depth"].shape == (4, 4, 3)
    np.testing.assert_array_equal(seen["ecm_0 observes rgb"], colours[0])


def test_a_choice_stays_in_its_menu_until_the_session_has_heard_of_it(viewer: Viewer) -> None:
    arms, agent = viewer._arms, viewer.session.env.agents[0]
    menu, before = arms._menus[agent], viewer.session.movers.who[agent]
    menu.value = "you"  # as the page sets it; what is to be done about it waits in the queue
    arms.sync()
    assert menu.value == "you"
    arms.sync(refused=True)
    assert menu.value == before


def test_a_run_is_named_in_the_menu(viewer: Viewer, tmp_path: Path) -> None:
    run = shutil.copytree(find("policies", "reach-bimanual_psm"), tmp_path / "run")
    arms, (first, second) = viewer._arms, viewer.session.env.agents
    before = viewer.session.movers.who[first]
    for wrong, words in (("", "type the folder of a run"), (str(tmp_path / "none"), "no such folder")):
        with pytest.raises(ValueError, match=words):
            arms._let_run(wrong, [second])
    arms._let_run(str(run), [second])
    assert viewer.session.movers.who == {first: before, second: str(run)}
    arms.sync()
    assert str(run) in arms._menus[first].options and arms._menus[second].value == str(run)
    viewer.session.set_mover(second, "zero")
    viewer.ask(lambda: viewer.choose(Choice("reach", "bimanual_psm", "default", 1, 50)))
    turn(viewer, 2)
    assert str(run) in viewer.session.choices


def test_a_run_without_a_checkpoint_can_not_move_an_arm(viewer: Viewer, tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text((find("policies", "reach-bimanual_psm") / "config.yaml").read_text())
    with pytest.raises(ValueError, match=r"has no checkpoint\.pt yet"):
        viewer.session.set_mover(viewer.session.env.agents[0], str(tmp_path))


def test_what_a_drawing_costs_as_json_and_as_a_sentence(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(page, "WARM", 0.1)
    assert main(["bench", "view", "--scene", "psm", "--seconds", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert list(found) == ["ms_per_drawing", "drawings_per_s", "kilobytes_per_drawing", "grown_mb", "mover"]
    assert found.pop("mover") == "reach-psm" and found.pop("grown_mb") < 1000
    assert all(value > 0 for value in found.values())
    assert main(["bench", "view", "--task", "reach", "--scene", "psm", "--seconds", "1"]) == 0
    said = capsys.readouterr().out
    assert "reach on psm, moved by reach-psm: " in said and said.endswith("MB of memory in 1 s\n")
