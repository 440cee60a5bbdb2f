"""How an object enters a MuJoCo scene: a textured visual mesh and its collision geoms."""

from typing import TYPE_CHECKING, Any

import numpy as np

from vap_core.simulation.assets.objects import ObjectModel, mesh_of, texture_image
from vap_core.simulation.assets.shapes import Hull, Number, Solid

if TYPE_CHECKING:
    import mujoco

VISUAL_GROUP, COLLISION_GROUP = 2, 3


def add_object(
    spec: "mujoco.MjSpec",
    model: ObjectModel,
    pos: tuple[Number, Number, Number] = (0, 0, 0),
    yaw: Number = 0.0,
) -> "mujoco.MjsBody":
    """Add the object, free to move, at `pos` (metres) and `yaw` (radians).

    The body's origin is the centre of the object's base. Its visual geom is in group 2 (no contact,
    no mass), its collision geoms in group 3; the free joint is `<name>/free`.
    """
    body = spec.worldbody.add_body(
        name=model.name, pos=pos, quat=(np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
    )
    body.add_freejoint(name=f"{model.name}/free")
    _add_visual_geom(spec, body, model)
    _add_collision_geoms(spec, body, model)
    return body


def _add_visual_geom(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", model: ObjectModel) -> None:
    import mujoco

    name = model.name
    picture = texture_image(model)
    height, width, _ = picture.shape
    texture = spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        width=width,
        height=height,
        nchannel=3,
    )
    texture.data = picture.tobytes()
    material = spec.add_material(name=name, specular=0.25, shininess=0.4)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    mesh = mesh_of(model)
    face = mesh.face.ravel().tolist()
    spec.add_mesh(
        name=name,
        uservert=mesh.vertex.ravel(),
        usernormal=mesh.normal.ravel(),
        usertexcoord=mesh.uv.ravel(),
        userface=face,
        userfacenormal=face,
        userfacetexcoord=face,
        inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
    )
    body.add_geom(
        name=f"{name}/visual",
        type=mujoco.mjtGeom.mjGEOM_MESH,
        meshname=name,
        material=name,
        group=VISUAL_GROUP,
        contype=0,
        conaffinity=0,
        density=0,
        mass=0,
    )


def _add_collision_geoms(spec: "mujoco.MjSpec", body: "mujoco.MjsBody", model: ObjectModel) -> None:
    """One geom per solid; the object's mass is shared out by volume."""
    solids: tuple[Solid | Hull, ...] = model.form.solids()
    volume = np.array([solid.volume for solid in solids])
    masses_kg = model.mass_kg * volume / volume.sum()
    for i, solid in enumerate(solids):
        name = f"{model.name}/solid{i}"
        body.add_geom(
            name=name,
            **_geom_form(spec, name, solid),
            group=COLLISION_GROUP,
            mass=float(masses_kg[i]),
            condim=4,
            friction=(1, 0.01, 0.001),
            solref=(0.004, 1),
            solimp=(0.95, 0.99, 0.001, 0.5, 2),
        )


def _geom_form(spec: "mujoco.MjSpec", name: str, solid: Solid | Hull) -> dict[str, Any]:
    """Type and place of a geom: a primitive, or a convex mesh that the spec gets under `name`."""
    import mujoco

    if isinstance(solid, Hull):
        spec.add_mesh(name=name, uservert=solid.vertex.ravel())
        return {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": name}
    quat = np.zeros(4)
    mujoco.mju_mat2Quat(quat, solid.rotation().ravel())
    return {
        "type": getattr(mujoco.mjtGeom, f"mjGEOM_{solid.kind.upper()}"),
        "size": (*solid.size, 0.0)[:3],
        "pos": solid.pos,
        "quat": quat,
    }
