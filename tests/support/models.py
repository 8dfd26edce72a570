"""Small models of robots."""

import numpy as np

FOUR_BAR = """
<mujoco model="four_bar">
  <compiler angle="radian"/>
  <default><joint axis="0 1 0"/><geom type="capsule" size="0.008"/></default>
  <worldbody>
    <body><joint name="crank" range="0.3 1.3"/><geom fromto="0 0 0 0 0 0.08"/>
      <body pos="0 0 0.08"><joint name="coupler"/><geom fromto="0 0 0 0.2 0 0"/><site name="tip" pos="0.2 0 0"/></body>
    </body>
    <body pos="0.2 0 0"><joint name="rocker"/><geom fromto="0 0 0 0 0 0.12"/><site name="end" pos="0 0 0.12"/></body>
  </worldbody>
  <equality><connect site1="tip" site2="end"/></equality>
  <actuator><position joint="crank" kp="8" kv="0.2" forcerange="-3 3"/></actuator>
</mujoco>
"""
"""A closed chain: a crank with a drive, a coupler and a rocker without."""

FINGER = FOUR_BAR.replace(
    '<geom fromto="0 0 0 0.2 0 0"/><site name="tip" pos="0.2 0 0"/></body>',
    """<geom fromto="0 0 0 0.1 0 0"/><body pos="0.1 0 0">
      <joint name="tip" range="-0.5 0" stiffness="0.02" springref="1" solreflimit="0.004 1"/>
      <geom fromto="0 0 0 0.1 0 0"/><site name="tip" pos="0.1 0 0"/></body></body>""",
)
"""The same with a joint in the coupler that the loop leaves free: a spring holds it against its stop."""

HEAD = """
<mujoco model="head"><compiler angle="radian"/><worldbody>
  <body><joint name="pan" axis="0 0 1" range="-2.5 2.5"/>
    <inertial pos="0 0 0.02" mass="0.25" diaginertia="3e-4 3e-4 4e-4"/>
    <body pos="0 0 0.05"><joint name="tilt" axis="0 1 0" range="-1.2 1.2"/>
      <inertial pos="0.03 0 0.01" mass="0.18" diaginertia="2e-4 2.5e-4 2e-4"/></body></body>
</worldbody><actuator>{}</actuator></mujoco>
"""
"""A head that pans and tilts, without its actuators."""
MOTORS = '<motor joint="pan" ctrlrange="-1.5 1.5"/><motor joint="tilt" ctrlrange="-1.5 1.5"/>'
KP, KD = np.array([6.0, 5.0]), np.array([0.08, 0.06])
"""Its motors, and gains for them."""

GANTRY = """
<mujoco model="gantry">
  <worldbody><body name="carriage"><joint name="axis" type="slide" axis="1 0 0" range="-0.3 0.3"/>
    <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
    <body name="arm"><joint name="swing" axis="0 1 0"/><inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/></body>
  </body></worldbody>
  <actuator><position joint="axis" kp="4000" kv="80" forcerange="-300 300"/><position joint="swing" kp="9" kv="1"/>
  </actuator>
</mujoco>
"""
"""A slide and, on it, a hinge."""
