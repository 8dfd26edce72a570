"""Leaving out of a model what its dynamics do not need: meshes, surfaces, pictures."""

from __future__ import annotations

from pathlib import Path

import mujoco

from pace_actuators.text import listed

_FROM_GEOMS = 1
"""``compiler/inertiafromgeom="true"``: stated inertias are not used."""


_HULL_VERTICES = 64
"""Most vertices of a mesh's convex hull, where the file states none: a contact searches all of them."""


def leave_out_meshes(spec: mujoco.MjSpec, path: Path, *, touches: bool = False) -> list[str]:
    """Delete geoms of meshes where no mass comes from them, and where their files are missing.

    Args:
        spec: The model; it is changed.
        touches: Whether geoms that collide stay.

    Returns:
        What was left out although it is needed, in plain sentences.
    """
    files = {mesh.name or Path(mesh.file).stem: mesh.file for mesh in spec.meshes}
    missing = {name for name, file in files.items() if file and not _exists(spec, path, file)}
    gone, massless, weighed = set(), [], set()
    for body in spec.bodies:
        stated = body.explicitinertial and int(spec.compiler.inertiafromgeom) != _FROM_GEOMS
        for geom in [geom for geom in body.geoms if geom.meshname]:
            if touches and geom.meshname not in missing and (geom.contype or geom.conaffinity):
                weighed |= set() if stated else {geom.meshname}
            elif stated or geom.meshname in missing:
                if not stated and geom.meshname in missing and _has_mass(geom):
                    massless.append(body.name or "world")
                gone.add(geom.name)
                spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms if geom.meshname}
    for mesh in list(spec.meshes):
        if (name := mesh.name or Path(mesh.file).stem) not in used:
            spec.delete(mesh)
        elif touches:
            mesh.maxhullvert = mesh.maxhullvert if mesh.maxhullvert > 0 else _HULL_VERTICES
            if name not in weighed:
                mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # of no mass: its surface may have holes
    _delete_references(spec, gone - {""})
    notes = []
    if missing:
        first = ", ".join(sorted(Path(files[name]).name for name in missing)[:2])
        notes.append(f"{len(missing)} mesh files are missing ({first}{', …' if len(missing) > 2 else ''}): left out.")
    fixed = [name for name in dict.fromkeys(massless) if name != "world"]
    if fixed:
        notes.append(f"The mass of {listed(fixed, 3)} was to come from a missing mesh and is taken as 0.")
    return notes


def missing_files(spec: mujoco.MjSpec, path: Path) -> list[str]:
    """Files that a model names and that are not there: meshes, skins, height fields, textures."""
    files = [element.file for element in [*spec.meshes, *_surfaces(spec)] if element.file]
    return [file for file in [*files, *_cube_files(spec)] if not _exists(spec, path, file)]


def leave_out_surfaces(spec: mujoco.MjSpec, path: Path) -> None:
    """Delete skins, height fields, textures and materials where one of their files is missing; colours stay."""
    files = [*(element.file for element in _surfaces(spec) if element.file), *_cube_files(spec)]
    if all(_exists(spec, path, file) for file in files):
        return
    for element in [*spec.geoms, *spec.sites, *spec.tendons]:
        element.material = ""
    for geom in [geom for geom in spec.geoms if geom.hfieldname]:
        spec.delete(geom)
    for element in [*spec.skins, *spec.materials, *spec.textures, *spec.hfields]:
        spec.delete(element)


def leave_out_pictures(spec: mujoco.MjSpec) -> None:
    """Delete textures: each copy of a model has its own, and they may be nearly all of it. Colours stay."""
    for material in spec.materials:
        material.textures = ["" for _ in material.textures]
    for texture in list(spec.textures):
        spec.delete(texture)


def _surfaces(spec: mujoco.MjSpec) -> list:
    return [*spec.skins, *spec.hfields, *spec.textures]


def _cube_files(spec: mujoco.MjSpec) -> list[str]:
    return [file for texture in spec.textures for file in texture.cubefiles if file]


def _exists(spec: mujoco.MjSpec, path: Path, file: str) -> bool:
    name = Path(file).name if spec.strippath else file
    folders = ("", spec.meshdir, spec.texturedir)
    return any((path.parent / folder / name).is_file() for folder in folders)


def _has_mass(geom: mujoco.MjsGeom) -> bool:
    return geom.mass > 0 if geom.mass == geom.mass else geom.density > 0


def _delete_references(spec: mujoco.MjSpec, geoms: set[str]) -> None:
    """Delete sensors and contact pairs of geoms that are gone."""
    for sensor in list(spec.sensors):
        named = ((sensor.objtype, sensor.objname), (sensor.reftype, sensor.refname))
        if any(kind == mujoco.mjtObj.mjOBJ_GEOM and name in geoms for kind, name in named):
            spec.delete(sensor)
    for pair in list(spec.pairs):
        if pair.geomname1 in geoms or pair.geomname2 in geoms:
            spec.delete(pair)
