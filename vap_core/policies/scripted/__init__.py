"""Policies written by hand: a baseline that reads only what a VLA reads, and the bounds, which do not."""
