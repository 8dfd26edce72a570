"""Film the replay of a run for the README: ``python docs/site/replay_film.py RUN [RECORDING]``.

The measured robot is a blue ghost. The simulated one is drawn with its error enlarged, and each link turns red with the
error of its joint. Needs EGL, or a screen.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # before MuJoCo is imported: no screen is needed

import mujoco
import numpy as np
from PIL import Image

from pace_optim.report.motion import motions_of
from pace_optim.report.motion.scene import scalar_joints
from pace_optim.report.run_data import RunData

FILM = Path(__file__).parents[1] / "images" / "replay.gif"
TIMES = 15.0
"""How much larger the error is drawn."""
PICTURES_S = 12.5
SIZE = (300, 460)
"""Height and width [pixels]."""
GHOST = (0.25, 0.5, 0.85, 0.35)
GREY, RED = np.array([0.75, 0.76, 0.78, 1.0]), np.array([0.86, 0.12, 0.08, 1.0])


def film(run: Path, recording: str | None = None) -> Path:
    """Write the film of one recording, the worst if none is named."""
    data = RunData.load(run)
    model, bias = data.model(), data.result.parameters["encoder_bias"]
    name = recording or data.worst(1)[0].name
    shown_ones = [each for each in data.recordings if each.name == name]
    (motion,) = motions_of(model, data.joint_names, shown_ones, [bias[joint] for joint in data.joint_names])
    joints = scalar_joints(model)
    address, bodies = model.jnt_qposadr[joints], model.jnt_bodyid[joints]
    error = motion.simulated - motion.measured
    red = np.abs(error) / np.abs(error).max()
    model.geom_matid[:] = -1
    model.geom_rgba[:] = GREY
    shown, ghost = mujoco.MjData(model), mujoco.MjData(model)
    camera = _camera(model, shown, address, motion.measured[0])
    pictures, step = [], max(1, round(1 / PICTURES_S / float(np.diff(motion.time).mean())))
    with mujoco.Renderer(model, *SIZE) as renderer:
        for k in range(0, len(motion.time), step):
            ghost.qpos[address] = motion.measured[k]
            shown.qpos[address] = motion.measured[k] + TIMES * error[k]
            mujoco.mj_kinematics(model, shown)
            mujoco.mj_kinematics(model, ghost)
            for body, part in zip(bodies, red[k], strict=True):
                model.geom_rgba[model.geom_bodyid == body] = (1 - part) * GREY + part * RED
            renderer.update_scene(shown, camera)
            _add_ghost(model, ghost, renderer.scene)
            pictures.append(Image.fromarray(renderer.render()))
    palette = pictures[len(pictures) // 2].quantize(48)
    small = [picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures]
    duration = round(1e3 * step * float(np.diff(motion.time).mean()))
    small[0].save(FILM, save_all=True, append_images=small[1:], duration=duration, loop=0, optimize=True)
    return FILM


def _camera(model: mujoco.MjModel, data: mujoco.MjData, address: np.ndarray, pose: np.ndarray) -> mujoco.MjvCamera:
    """Looks at the robot from its front left."""
    data.qpos[address] = pose
    mujoco.mj_forward(model, data)
    visible = data.geom_xpos[model.geom_bodyid > 0]
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (visible.min(axis=0) + visible.max(axis=0)) / 2
    camera.distance = 1.05 * float(np.linalg.norm(np.ptp(visible, axis=0)))
    camera.azimuth, camera.elevation = 130.0, -12.0
    return camera


def _add_ghost(model: mujoco.MjModel, ghost: mujoco.MjData, scene: mujoco.MjvScene) -> None:
    first = scene.ngeom
    category = mujoco.mjtCatBit.mjCAT_DYNAMIC
    mujoco.mjv_addGeoms(model, ghost, mujoco.MjvOption(), mujoco.MjvPerturb(), category, scene)
    for i in range(first, scene.ngeom):
        scene.geoms[i].rgba[:] = GHOST


if __name__ == "__main__":
    print(film(Path(sys.argv[1]), sys.argv[2] if len(sys.argv) > 2 else None))
