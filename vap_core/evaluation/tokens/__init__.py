"""What the learned tokens of personal objects recognize, in the model and in the policies."""
