"""Servers on this machine: a policy behind a wire, and the prompting proxy before another's."""
