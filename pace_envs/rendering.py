"""Pictures of one environment, without a screen."""

import mujoco
import numpy as np

from pace_envs.simulation import Simulation

_DRAWN = 2
"""Last group of geoms that MuJoCo draws by default."""


def drawn(model: mujoco.MjModel) -> mujoco.MjModel:
    """The same model; bodies of which nothing would be drawn, as their meshes are left out, show all their geoms."""
    for body in range(model.nbody):
        own = model.geom_bodyid == body
        if (model.geom_group[own] > _DRAWN).all():
            model.geom_group[own] = _DRAWN
    return model


class OffscreenRenderer:
    """Draws environment 0 with MuJoCo's renderer; without a screen, set MUJOCO_GL to egl or osmesa."""

    def __init__(self, sim: Simulation, width: int = 1280, height: int = 720):
        """Create the renderer; it follows a floating base, through the model's camera ``track`` where there is one.

        Raises:
            RuntimeError: If there is no OpenGL.
        """
        self._sim = sim
        cameras = [sim.model.camera(i).name for i in range(sim.model.ncam)]
        self._model = drawn(sim.model_of(0))
        self._camera: str | mujoco.MjvCamera = "track" if "track" in cameras else _following(self._model)
        self._data = mujoco.MjData(self._model)
        try:
            self._renderer = mujoco.Renderer(self._model, height, width)
        except (mujoco.FatalError, RuntimeError) as error:
            raise RuntimeError(
                f"MuJoCo cannot draw: {error}. Without a screen, set MUJOCO_GL=egl (or osmesa) before Python starts."
            ) from None

    def render(self) -> np.ndarray:
        """The picture, (height, width, 3) uint8."""
        self._sim.read_data(0, self._data)
        mujoco.mj_forward(self._model, self._data)
        self._renderer.update_scene(self._data, camera=self._camera)
        return self._renderer.render()

    def close(self) -> None:
        """Release the renderer."""
        self._renderer.close()


def _following(model: mujoco.MjModel) -> mujoco.MjvCamera:
    """MuJoCo's own view of a model, which goes along with a floating base."""
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if model.njnt and model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE:
        camera.type, camera.trackbodyid = mujoco.mjtCamera.mjCAMERA_TRACKING, int(model.jnt_bodyid[0])
    return camera
