"""Good files of all kinds that are loaded, as texts: what fuzzing begins with."""

from __future__ import annotations

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1e-2" iyy="1e-2" izz="1e-2" ixy="0" ixz="0" iyz="0"/></inertial>'
SHAPE = '<geometry><mesh filename="part.stl" scale="1 1 1"/></geometry>'
LIMIT = '<limit lower="-1" upper="1" velocity="1" effort="1"/>'
URDF = f"""<robot name="two">
  <material name="red"><color rgba="1 0 0 1"/></material>
  <link name="base"><visual>{SHAPE}<material name="red"/></visual></link>
  <link name="upper">{INERTIAL}<visual>{SHAPE}</visual><collision name="shell">{SHAPE}</collision></link>
  <link name="lower">{INERTIAL}<visual><origin xyz="0 0 1" rpy="0 0.1 0"/>{SHAPE}</visual>
    <collision name="shell"><geometry><box size="0.1 0.2 0.4"/></geometry></collision>
    <collision><geometry><cylinder radius="0.1" length="0.2"/></geometry></collision></link>
  <link name="tip"/>
  <joint name="first" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>{LIMIT}
    <dynamics damping="0.1" friction="0.1"/></joint>
  <joint name="second" type="prismatic"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.5"/><axis xyz="0 0 1"/><limit lower="0" upper="0.2" velocity="1" effort="1"/>
    <mimic joint="first" multiplier="0.1" offset="0"/></joint>
  <joint name="fixed" type="fixed"><parent link="lower"/><child link="tip"/></joint>
</robot>
"""
SPHERES = (
    URDF.replace('<mesh filename="part.stl" scale="1 1 1"/>', '<sphere radius="0.05"/>')
    .replace('<mimic joint="first" multiplier="0.1" offset="0"/>', "")
    .replace('<dynamics damping="0.1" friction="0.1"/>', "")
)
ARM = """urdf: two.urdf
tool_tip: lower
joints: {first: {stiffness: 10, damping: 1, speed: 1}, second: {stiffness: 10, damping: 1, speed: 1}}
"""
JAW = """jaw: {joint: first, open: 1, closed: 0, pads: {upper: {size: [1, 1, 1]}}}
camera: {link: lower, fovy: 60, baseline: 0.1}
"""
CABLES = "cables: [{joints: {first: 1, second: 2}, stiffness: 1, damping: 1, effort: 1}]\n"
OBJECT = """free: true
mass: 0.01
friction: {sliding: 0.5, torsion: 0.001}
stiffness: 1.0e+5
shapes: [{sphere: {radius: 0.01}}]
"""
SCENE = """arms: {two_0: {arm: two, position: [0, 0, 0], turn: 10, tilt: [0, 0, 0], workspace: [0, 0, 0.5]}}
view: {position: [0, 1, 0.4], target: [0, 0, 0.1]}
tissue: {liver: {shape: box, size: [0.1, 0.1, 0.1], position: [0, 0, 0], tilt: [0, 0, 0], colour: [1, 0, 0]}}
objects: {ball: {object: ball.yaml, position: [3, 0, 1], tilt: [0, 0, 0], colour: [0, 0, 1]}}
randomisation: {payload: 0.1, latency: 2, object_size: 0.1}
observe: {two_0: [qpos]}
"""
SCENE_OF_TWO = """arms:
  two_0: {arm: two, position: [0, 0, 0]}
  two_1: {arm: two, position: [2, 0, 0], turn: 180}
tissue: {}
"""
SETTINGS = """task: reach
scene: psm
num_envs: 8
observe: {psm_0: [qpos]}
reward: {collision: -1}
ppo: {gamma: 0.9}
network: {hidden: [8, 8], recurrent: none}
versions: {torch: '1'}
"""
TINY = """task: reach
scene: psm
engine: fused
device: cpu
num_envs: 2
iterations: 3
steps_per_iteration: 2
ppo: {mini_batches: 1}
network: {hidden: [2]}
"""
OBJ = """mtllib a.mtl
o a
v 0 0 0
v 1 0 0 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vn 0 0 1
g b
usemtl c
f 1/1/1 2/1/1 3/1/1
f 1//1 2//1 4//1
s off
f -4 -3 -2 -1
l 1 2
"""
DAE = """<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.1"/></asset>
<library_geometries><geometry id="g"><mesh><source id="s"><float_array id="a" count="12">0 0 0 1 0 0 0 1 0 0 0 1
</float_array><technique_common><accessor source="#a" count="4" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#s"/></vertices><triangles count="4">
<input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2 0 1 3 0 2 3 1 2 3</p></triangles></mesh></geometry>
</library_geometries><library_visual_scenes><visual_scene id="w"><node id="n"><matrix>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1
</matrix><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#w"/></scene></COLLADA>"""
