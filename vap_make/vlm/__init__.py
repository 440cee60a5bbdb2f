"""Training of the mini-PaliGemma that policies and learned tokens start from."""
