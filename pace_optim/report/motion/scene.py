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
_TRIANGLES_PER_MESH = 1500
"""A finer mesh is drawn with fewer."""
_BONE = 0.03
"""Radius of the bones of links that have no shape, as a part of the robot's size."""
_BONE_COLOUR = (0.6, 0.6, 0.62, 1.0)


def scene_of(model: mujoco.MjModel, looks: mujoco.MjModel | None = None) -> dict[str, Any]:
    """What a robot looks like: its shapes, and bones from joint to joint of links that have none.

    Args:
        model: The compiled model.
        looks: A model whose bodies have the shapes of those of the same name; ``None``: the model's own.

    Returns:
        ``bodies`` (name, parent, position [m] and quaternion in the parent; index 0 is the world), ``joints`` (body,
        type, axis and anchor in the body, reference), ``geoms`` (body, shape, half sizes [m], position, quaternion,
        colour, or the vertices and faces of a mesh) and ``center`` and ``size`` [m] of the whole.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = [_geom(source, g) | {"body": body} for source, g, body in _shown(model, looks)]
    shaped = {int(model.body_weldid[geom["body"]]) for geom in geoms}
    extent = np.ptp(data.xpos[1:], axis=0) if model.nbody > 1 else np.zeros(3)
    geoms += _bones(model, [b for b in range(1, model.nbody) if int(model.body_weldid[b]) not in shaped], extent)
    low, high = _box(geoms, data)
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
        "geoms": geoms,
        "center": _rounded((low + high) / 2),
        "size": max(0.05, float(np.linalg.norm(high - low))),
    }


def _shown(model: mujoco.MjModel, looks: mujoco.MjModel | None) -> list[tuple[mujoco.MjModel, int, int]]:
    """Visible shapes: the model that has each, its index there, and its body in the first one."""
    found: list[tuple[mujoco.MjModel, int, int]] = []
    ids = {model.body(b).name: b for b in range(1, model.nbody)}
    if looks is not None:
        bodies = [looks.body(int(looks.geom_bodyid[g])).name for g in range(looks.ngeom)]
        found = [(looks, g, ids[name]) for g, name in enumerate(bodies) if name in ids and _is_visible(looks, g)]
    seen = {body for _, _, body in found}
    own = [(model, g, int(model.geom_bodyid[g])) for g in range(model.ngeom)]
    visible = [each for each in own if _is_visible(model, each[1])]
    if all(body == 0 for _, _, body in [*visible, *found]):  # a model without visual groups: take what collides
        visible = [each for each in own if each[2] != 0 and int(model.geom_type[each[1]]) in map(int, _SHAPES)]
    return [*found, *(each for each in visible if each[2] not in seen)]


def _bones(model: mujoco.MjModel, bodies: list[int], extent: np.ndarray) -> list[dict[str, Any]]:
    """From the first joint of each body to those of its children, or to its own centre of mass at an end."""
    radius = _BONE * max(float(np.linalg.norm(extent)), 0.05)
    geoms = []
    for b in bodies:
        first = int(model.body_jntadr[b])
        start = model.jnt_pos[first] if first >= 0 else np.zeros(3)
        children = [c for c in range(1, model.nbody) if int(model.body_parentid[c]) == b]
        ends = [_place_of_first_joint(model, c) for c in children] or [model.body_ipos[b]]
        for end in ends:
            along = end - start
            half = 0.5 * float(np.linalg.norm(along))
            quat = np.array([1.0, 0.0, 0.0, 0.0])
            if half > 0:
                mujoco.mju_quatZ2Vec(quat, along)
            shape = {"shape": "capsule", "size": _rounded(np.array([radius, half, 0.0]))}
            pose = {"pos": _rounded((start + end) / 2), "quat": _rounded(quat)}
            geoms.append({"body": b, "rgba": list(_BONE_COLOUR), **shape, **pose})
    return geoms


def _place_of_first_joint(model: mujoco.MjModel, body: int) -> np.ndarray:
    """In the frame of the body's parent."""
    first = int(model.body_jntadr[body])
    turned = np.zeros(3)
    mujoco.mju_rotVecQuat(turned, model.jnt_pos[first] if first >= 0 else np.zeros(3), model.body_quat[body])
    return model.body_pos[body] + turned


def _box(geoms: list[dict[str, Any]], data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Where shapes are at the reference posture: lowest and highest corner [m]."""
    points = [np.zeros((1, 3))] if not geoms else []
    for geom in geoms:
        size = np.array(geom["size"])
        corners = np.array([geom.get("shift", np.zeros(3))])
        if geom["shape"] == "mesh":
            corners = np.array(geom["vertices"]).reshape(-1, 3)
            corners = np.array([corners.min(axis=0), corners.max(axis=0)])
        reach = 0.0 if geom["shape"] == "mesh" else float(size.max())
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.array(geom["quat"]))
        local = corners @ turn.reshape(3, 3).T + geom["pos"]
        world = local @ data.xmat[geom["body"]].reshape(3, 3).T + data.xpos[geom["body"]]
        points += [world - reach, world + reach]
    every = np.concatenate(points)
    return every.min(axis=0), every.max(axis=0)


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
    vertices, faces = _surface(model, int(model.geom_dataid[g]))
    return geom | {"shape": "mesh", "vertices": _rounded(vertices.ravel(), 4), "faces": faces.ravel().tolist()}


def _colour(model: mujoco.MjModel, g: int) -> np.ndarray:
    material = int(model.geom_matid[g])
    return model.mat_rgba[material] if material >= 0 else model.geom_rgba[g]


def _surface(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) [m] and faces (F, 3) of a mesh; of a fine one, points in the same cell of a grid are one."""
    start, first = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[start : start + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[first : first + model.mesh_facenum[mesh]]
    low, width = vertices.min(axis=0), float(np.ptp(vertices, axis=0).max()) or 1.0
    cells, points, found = 64, vertices, faces
    while len(found) > _TRIANGLES_PER_MESH and cells > 1:
        key = np.floor((vertices - low) / width * cells).astype(int)
        _, place, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
        place = place.ravel()
        points = np.stack([np.bincount(place, axis, len(count)) / count for axis in vertices.T], axis=1)
        found = place[faces]
        found = found[(found[:, 0] != found[:, 1]) & (found[:, 1] != found[:, 2]) & (found[:, 2] != found[:, 0])]
        _, kept = np.unique(np.sort(found, axis=1), axis=0, return_index=True)
        found, cells = found[np.sort(kept)], int(cells * 0.8)
    return points, found


def _rounded(values: np.ndarray, digits: int = 6) -> list[float]:
    return np.asarray(values, dtype=float).round(digits).tolist()
