"""A robot's bodies, joints and shapes as plain numbers that a page can draw."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

_SHAPES = {
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_ELLIPSOID: "ellipsoid",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
}
_JOINTS = {mujoco.mjtJoint.mjJNT_HINGE: "hinge", mujoco.mjtJoint.mjJNT_SLIDE: "slide"}
_VISIBLE_GROUPS = 3
"""Groups that MuJoCo's viewers show from the start: 0, 1 and 2."""
_TRIANGLES_PER_MESH = 2000
"""A finer mesh is drawn as its convex hull, or as a box where MuJoCo made no hull of it."""


def scene_of(model: mujoco.MjModel) -> dict[str, Any]:
    """What a robot looks like.

    Args:
        model: The compiled model.

    Returns:
        ``bodies`` (name, parent, position [m] and quaternion in the parent; index 0 is the world), ``joints`` (body,
        type, axis and anchor in the body, reference), ``geoms`` (body, shape, half sizes [m], position, quaternion,
        colour, or the vertices and faces of a mesh) and ``center`` and ``size`` [m] of the whole.
    """
    visible = [g for g in range(model.ngeom) if _is_visible(model, g)]
    if all(model.geom_bodyid[g] == 0 for g in visible):  # a model without visual groups: take what collides
        visible = [g for g in range(model.ngeom) if model.geom_bodyid[g] != 0]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    points = data.geom_xpos[visible] if visible else data.xpos
    low, high = points.min(axis=0), points.max(axis=0)
    return {
        "bodies": [
            {
                "name": model.body(b).name or f"body {b}",
                "parent": int(model.body_parentid[b]),
                "pos": _rounded(model.body_pos[b]),
                "quat": _rounded(model.body_quat[b]),
            }
            for b in range(model.nbody)
        ],
        "joints": [
            {
                "body": int(model.jnt_bodyid[j]),
                "type": _JOINTS[mujoco.mjtJoint(model.jnt_type[j])],
                "axis": _rounded(model.jnt_axis[j]),
                "pos": _rounded(model.jnt_pos[j]),
                "ref": float(model.qpos0[model.jnt_qposadr[j]]),
            }
            for j in scalar_joints(model)
        ],
        "geoms": [_geom(model, g) for g in visible],
        "center": _rounded((low + high) / 2),
        "size": max(0.2, float(np.linalg.norm(high - low))),
    }


def scalar_joints(model: mujoco.MjModel) -> list[int]:
    """Indices of the hinge and slide joints, in the model's order."""
    return [j for j in range(model.njnt) if mujoco.mjtJoint(model.jnt_type[j]) in _JOINTS]


def _is_visible(model: mujoco.MjModel, g: int) -> bool:
    shape = mujoco.mjtGeom(model.geom_type[g])
    drawn = shape in _SHAPES or shape == mujoco.mjtGeom.mjGEOM_MESH
    return drawn and model.geom_group[g] < _VISIBLE_GROUPS and model.geom_rgba[g, 3] > 0


def _geom(model: mujoco.MjModel, g: int) -> dict[str, Any]:
    shape = mujoco.mjtGeom(model.geom_type[g])
    geom: dict[str, Any] = {
        "body": int(model.geom_bodyid[g]),
        "pos": _rounded(model.geom_pos[g]),
        "quat": _rounded(model.geom_quat[g]),
        "rgba": _rounded(_colour(model, g)),
        "size": _rounded(model.geom_size[g]),
    }
    if shape != mujoco.mjtGeom.mjGEOM_MESH:
        return geom | {"shape": _SHAPES[shape]}
    mesh = int(model.geom_dataid[g])
    surface = _surface(model, mesh)
    if surface is None:
        low_high = model.geom_aabb[g]
        return geom | {"shape": "box", "size": _rounded(low_high[3:]), "shift": _rounded(low_high[:3])}
    vertices, faces = surface
    return geom | {"shape": "mesh", "vertices": _rounded(vertices.ravel(), 5), "faces": faces.ravel().tolist()}


def _colour(model: mujoco.MjModel, g: int) -> np.ndarray:
    material = int(model.geom_matid[g])
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]


def _surface(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (V, 3) [m] and faces (F, 3) of a mesh, or of its convex hull where it is fine."""
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[start : start + count]
    if model.mesh_facenum[mesh] <= _TRIANGLES_PER_MESH:
        first = model.mesh_faceadr[mesh]
        return vertices, model.mesh_face[first : first + model.mesh_facenum[mesh]]
    at = model.mesh_graphadr[mesh]
    if at < 0:
        return None
    # mesh_graph: number of vertices and faces, where edges begin, vertices' global ids, edges, faces (global ids)
    hull_vertices, hull_faces = int(model.mesh_graph[at]), int(model.mesh_graph[at + 1])
    if hull_faces > _TRIANGLES_PER_MESH:
        return None
    ids = model.mesh_graph[at + 2 + hull_vertices : at + 2 + 2 * hull_vertices]
    edges = hull_vertices + 3 * hull_faces
    first = at + 2 + 2 * hull_vertices + edges
    faces = model.mesh_graph[first : first + 3 * hull_faces].reshape(-1, 3)
    local = np.full(count, -1)
    local[ids] = np.arange(hull_vertices)
    return vertices[ids], local[faces]


def _rounded(values: np.ndarray, digits: int = 6) -> list[float]:
    return np.asarray(values, dtype=float).round(digits).tolist()
