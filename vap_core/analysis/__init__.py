"""Figures and measurements that the notebooks call."""
