"""Training of mini-pi0 policies on filmed demonstrations."""
