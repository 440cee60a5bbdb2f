"""Training of the embedded stack's heads."""
