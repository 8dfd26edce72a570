"""A closed chain: a crank with a drive, a coupler and a rocker without."""

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

FINGER = FOUR_BAR.replace(
    '<geom fromto="0 0 0 0.2 0 0"/><site name="tip" pos="0.2 0 0"/></body>',
    """<geom fromto="0 0 0 0.1 0 0"/><body pos="0.1 0 0">
      <joint name="tip" range="-0.5 0" stiffness="0.02" springref="1" solreflimit="0.004 1"/>
      <geom fromto="0 0 0 0.1 0 0"/><site name="tip" pos="0.1 0 0"/></body></body>""",
)
"""The same with a joint in the coupler that the loop leaves free: a spring holds it against its stop."""
