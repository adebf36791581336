"""How contacts answer a violation: as C MuJoCo says, for every kind of `solref` and `solimp`."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surgical_marl.physics.solver.solref import response
from surgical_marl.physics.systems.dynamics import Dynamics

POWERS = st.sampled_from([1.0, 2.0, 3.5])
REFERENCES = st.one_of(
    st.tuples(st.floats(0.0005, 0.1), st.floats(0.3, 2.0)),  # the shortest is below two steps
    st.tuples(st.floats(-5000, -1), st.floats(-100, -1)),
)
LEAST = st.one_of(st.just(0.0), st.floats(0.001, 1))  # 0 is raised to the least that MuJoCo allows
IMPEDANCES = st.tuples(LEAST, st.floats(0.05, 1), st.floats(1e-4, 0.01), st.floats(0.1, 0.9), POWERS)


Numbers = tuple[float, ...]


def touching(solref: Numbers, solimp: Numbers, depth: float) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """A ball on a slide, so deep in the ground and on its way deeper."""
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option timestep="0.0025" gravity="0 0 0" jacobian="dense"/><worldbody>
        <geom name="ground" type="plane" size="1 1 1"/>
        <body name="ball"><joint type="slide" axis="0 0 1"/><geom name="ball" size="0.1" mass="0.5"/></body></worldbody>
        <contact><pair geom1="ground" geom2="ball" condim="1" solref="{" ".join(map(repr, solref))}"
        solimp="{" ".join(map(repr, solimp))}"/></contact></mujoco>"""
    )
    data = mujoco.MjData(model)
    data.qpos[0], data.qvel[0] = 0.1 - depth, -0.2
    mujoco.mj_forward(model, data)
    assert data.nefc == 1
    return model, data


@settings(max_examples=100, deadline=None)
@given(REFERENCES, IMPEDANCES, st.floats(1e-5, 0.02))
def test_stiffness_damping_and_impedance_are_those_of_c_mujoco(solref: Numbers, solimp: Numbers, depth: float) -> None:
    model, data = touching(solref, solimp, depth)
    found = response(model.pair_solref[0], model.pair_solimp[0], data.efc_pos, model.opt.timestep)
    expected = data.efc_KBIP[0, :3]
    assert [float(np.squeeze(part)) for part in found] == pytest.approx(expected, rel=2e-4, abs=1e-6)


@pytest.mark.parametrize("depth", [1e-4, 0.0004, 0.0007, 0.003])
def test_the_row_of_a_contact_is_that_of_c_mujoco(depth: float) -> None:
    model, data = touching((0.005, 1.0), (0.9, 0.95, 0.001, 0.5, 2.0), depth)
    weight = model.body_invweight0[model.geom("ball").bodyid[0], :1]
    rows = Dynamics(model).contact_rows(*(np.float32(x) for x in (data.efc_J, data.efc_pos, weight, data.qvel)))
    assert float(rows.impedance[0]) == pytest.approx(data.efc_D[0], rel=1e-4)
    assert float(rows.reference[0]) == pytest.approx(data.efc_aref[0], rel=1e-4)
