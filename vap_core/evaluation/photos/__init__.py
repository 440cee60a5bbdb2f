"""How well registering, grounding and the vote do on a folder of real photos."""
