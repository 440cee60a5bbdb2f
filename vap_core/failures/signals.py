"""What a real robot's failure shows by itself: without truth there is no case, but votes and tracks have something to say."""

from vap_core.failures.labels import Diagnosis
from vap_core.values import Episode

NARROW = 0.25
"""A vote won by less of the references than this could as well have gone to another."""


def unlabelled(episode: Episode) -> Diagnosis:
    """What can be said without truth: the narrowest vote, tracks that were lost, and how differently the views liked what they chose."""
    groundings = [per_target[0] for per_target in episode.opening.groundings.values() if per_target]
    found = [g for g in groundings if g.winner is not None]
    lost = [event.frame_index for frame in episode.frames for event in frame.events if "not visible, the view passes unmodified" in event.text]
    likings = [float(g.similarity[g.winner].mean()) for g in found]
    narrowest = min(found, key=lambda g: g.margin, default=None)
    margin = 0.0 if narrowest is None else narrowest.margin
    evidence: dict[str, float | str] = {
        "margin": margin, "lost": float(len(lost)), "disagreement": max(likings) - min(likings) if likings else 0.0,
        "views_without": float(len(groundings) - len(found)),
    }  # fmt: skip
    at, camera = 0, "" if narrowest is None else narrowest.camera
    if not found:
        sub_case, words = "nothing found", "no view has a candidate"
    elif margin < NARROW:
        sub_case, words = "narrow vote", f"{camera}: the vote was won by {margin:.2f} of the references only"
    elif lost:
        sub_case, at, words = "lost track", lost[0], f"the target was lost {len(lost)} times, first at step {lost[0]}"
    else:
        sub_case, at, words = "no signal", episode.frames[-1].frame_index, "votes and tracks give no sign of what went wrong"
    return Diagnosis("unlabelled", sub_case, at, camera if at == 0 else "", evidence, 0.0, words)
