"""A robot's model as the environment wants it: its base fixed or floating, its geoms by name."""

from __future__ import annotations

import itertools
import warnings

import mujoco

from pace_actuators import match_names
from pace_envs.articulation_cfg import ArticulationCfg
from pace_envs.model_file import compile_model, read_model_file


def load_robot_spec(cfg: ArticulationCfg, *, touches: bool = False) -> mujoco.MjSpec:
    """Read a robot's model file; its base is fixed or floating as the configuration says.

    Args:
        cfg: The robot.
        touches: Whether it touches anything: meshes that collide stay, and each geom that collides has a name.

    Raises:
        ValueError: If the file is missing or no usable model, or has no base that could float.
    """
    file = read_model_file(cfg.mjcf_path, touches=touches)
    spec = file.spec
    compile_model(spec, cfg.mjcf_path)  # a fault of the file is told with its name
    if touches:
        for note in file.notes:
            warnings.warn(f"{cfg.mjcf_path}: {note}", stacklevel=2)
        _name_geoms(spec)
    free = [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]
    if cfg.fix_base:
        for joint in free:
            base = joint.parent
            base.pos, base.quat = cfg.init_state.pos, cfg.init_state.rot
            spec.delete(joint)
    elif cfg.fix_base is False and not free:
        _let_float(spec, cfg)
    return spec


def find_geoms(spec: mujoco.MjSpec, expressions: str | tuple[str, ...]) -> list[mujoco.MjsGeom]:
    """The colliding geoms that expressions name.

    An expression that matches no name of a geom names bodies, and means all of their geoms.

    Args:
        spec: A robot whose colliding geoms have names.
        expressions: Regular expressions.

    Raises:
        ValueError: If an expression matches nothing.
    """
    geoms = _colliding(spec)
    owners = [geom.parent.name for geom in geoms]
    bodies = list(dict.fromkeys(owners))
    found: set[int] = set()
    for group in match_names(expressions, [*(g.name for g in geoms), *bodies], what="colliding geom or body"):
        named = {bodies[i - len(geoms)] for i in group if i >= len(geoms)}
        found |= {i for i in group if i < len(geoms)} or {i for i, owner in enumerate(owners) if owner in named}
    return [geoms[i] for i in sorted(found)]


def _colliding(spec: mujoco.MjSpec) -> list[mujoco.MjsGeom]:
    return [geom for geom in spec.geoms if geom.contype or geom.conaffinity]


def _name_geoms(spec: mujoco.MjSpec) -> None:
    """Name the colliding geoms without a name after their bodies: ``body/0``, ``body/1``."""
    taken = {geom.name for geom in spec.geoms}
    for geom in _colliding(spec):
        if not geom.name:
            names = (f"{geom.parent.name}/{k}" for k in itertools.count())
            geom.name = next(name for name in names if name not in taken)
            taken.add(geom.name)


def _let_float(spec: mujoco.MjSpec, cfg: ArticulationCfg) -> None:
    bases = spec.worldbody.bodies
    if len(bases) != 1 or bases[0].joints:
        names = ", ".join(body.name for body in bases) or "none"
        raise ValueError(
            f"{cfg.mjcf_path} has no base that could float: expected one body without a joint in the world, found "
            f"{names}. Give the base a <freejoint/> in the file, or set fix_base=None."
        )
    bases[0].add_freejoint()
