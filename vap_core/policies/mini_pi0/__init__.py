"""mini-pi0: lerobot's own PI0 at a size that a CPU can train and run.

It is a registered lerobot policy like any other. Three modules are named as lerobot's factory wants
them: importing the configuration registers the policy and its tokenizer.
"""
