"""Policies that lerobot loads, and the method as a step of lerobot's own pipelines."""
