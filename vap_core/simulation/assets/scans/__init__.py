"""A user's own scans: read from a file, repaired, textured, stored and loaded again."""
