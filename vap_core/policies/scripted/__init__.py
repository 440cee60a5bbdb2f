"""Policies written by hand: a baseline that reads what a VLA reads, and the bounds."""
