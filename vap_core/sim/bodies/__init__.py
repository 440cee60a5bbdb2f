"""Parametric bodies, a module a kind: frozen lengths that give a mesh and its collision solids (shapes.Shape)."""
