"""Rendered views and filmed demonstrations of generic objects."""
