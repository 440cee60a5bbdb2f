"""The objects of the scenes: parametric meshes and textures, and imported scans."""
