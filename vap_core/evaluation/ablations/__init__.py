"""Ablations: the method with one thing changed at a time (P appendix)."""
