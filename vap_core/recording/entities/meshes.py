"""The objects' own meshes, as assets that never change."""

from functools import lru_cache

import cv2
import numpy as np
import rerun as rr

from vap_core.base.errors import UnknownName
from vap_core.simulation.assets.objects import get_object, mesh_of, texture_image

TEXTURE_PX = 96
"""Side of an object's picture in a recording; the simulator's is five times as large."""


@lru_cache(maxsize=256)
def object_mesh(name: str) -> rr.Mesh3D | None:
    """An object's shape and decoration; None for one that the registry does not hold."""
    try:
        model = get_object(name)
    except UnknownName:
        return None
    mesh = mesh_of(model)
    picture = texture_image(model)
    side = (TEXTURE_PX, TEXTURE_PX)
    small = cv2.resize(picture, side, interpolation=cv2.INTER_AREA)
    return rr.Mesh3D(
        vertex_positions=mesh.vertex.astype(np.float32),
        triangle_indices=mesh.face.astype(np.uint32),
        vertex_normals=mesh.normal.astype(np.float32),
        vertex_texcoords=mesh.uv.astype(np.float32),
        albedo_texture=small.astype(np.uint8),
    )
