"""What a step, a start and a query cost; every figure is a ratio within one run."""
