"""A user's own scans: read and checked (source), closed (closing), painted (bake), brought into the registry (bring), kept on disk (stored)."""
