"""Names that other packages keep to themselves: few, each in one place, and missed in a sentence when one moves."""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator

import mujoco
import pytest
from rsl_rl.models import MLPModel

from surgical_marl.runtime import prepare_mjx
from tests.helpers import ROOT

PACKAGE = ROOT / "surgical_marl"


def test_no_private_module_of_another_package_is_imported() -> None:
    private = [
        f"{path.relative_to(PACKAGE)}: {module}"
        for path in PACKAGE.rglob("*.py")
        for module in modules(ast.parse(path.read_text()))
        if any(part.startswith("_") and part != "__future__" for part in module.split("."))
    ]
    assert not private


def modules(tree: ast.Module) -> Iterator[str]:
    """What a module imports, with the names that it takes from there."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            own = str(node.module).startswith("surgical_marl")
            yield from (str(node.module) if own else f"{node.module}.{alias.name}" for alias in node.names)


def test_jax_still_says_whether_it_has_started() -> None:
    bridge = importlib.import_module("jax._src.xla_bridge")
    assert callable(getattr(bridge, "backends_are_initialized", None)), (
        "jax moved xla_bridge.backends_are_initialized: runtime._backend_started needs its new place"
    )


def test_mjx_still_has_its_rows_where_dynamics_reads_them() -> None:
    mjx = prepare_mjx()
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><joint name="j" frictionloss="1"/><geom size="0.1"/></body></worldbody>'
        '<actuator><motor joint="j"/></actuator></mujoco>'
    )
    data = mjx.make_data(model)
    for name in ("M", "actuator_moment", "efc_J", "efc_D", "efc_aref", "efc_frictionloss"):
        assert hasattr(data._impl, name), f"mujoco-mjx moved data._impl.{name}: physics.dynamics needs its new place"


def test_mjx_still_carries_mujoco_warp() -> None:
    pytest.importorskip("warp")
    prepare_mjx()
    try:
        warp = importlib.import_module("mujoco.mjx.third_party.mujoco_warp")
    except ImportError:
        pytest.fail(
            "mujoco-mjx moved third_party.mujoco_warp: vision.endoscope and bench.other_simulators need its new place"
        )
    for name in ("put_model", "make_data", "kinematics", "camlight", "step", "OverflowType"):
        assert hasattr(warp, name), (
            f"mujoco_warp moved {name}: vision.endoscope or bench.other_simulators needs its new place"
        )


def test_rsl_rl_still_asks_its_models_how_wide_they_are_before_the_mlp() -> None:
    assert hasattr(MLPModel, "_get_latent_dim"), (
        "rsl_rl renamed MLPModel._get_latent_dim: policies.recurrent overrides it and needs its new name"
    )
