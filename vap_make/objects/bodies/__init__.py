"""Parametric bodies: frozen lengths that give a mesh and its collision solids (`shapes.Shape`).

At half to three quarters of its height every body but the receptacles is 34 to 44 mm wide across
any yaw (the camera: along y), for two fingers from above.
"""
