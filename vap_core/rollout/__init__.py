"""The closed loop, and the episodes that it makes."""
