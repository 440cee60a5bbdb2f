"""From which cosine on an object is in view: the thresholds of a stack, from development scenes."""
