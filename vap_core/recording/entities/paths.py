"""The parts of entity paths that several entities share."""


def image_root(camera: str) -> str:
    """The entity of a camera's pictures."""
    return f"/observation.images.{camera}"


def target_suffix(j: int) -> str:
    """What a further target's entities end in; nothing for the first target."""
    return f"_{j}" if j else ""
