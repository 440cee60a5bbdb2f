"""Failures without ground truth, as on a real robot: no case, but signals from votes and tracks."""

from vap_core.base.events import describe_rejection, is_lost
from vap_core.rollout.failure import Diagnosis
from vap_core.rollout.types import Episode

NARROW = 0.25
"""A vote that is won by a smaller share of the references is a signal."""


def unlabelled(episode: Episode) -> Diagnosis:
    """The narrowest vote, lost tracks, and how differently similar the views' choices are."""
    found = []
    similarities = []
    rejected = []
    views_without = 0
    for groundings in episode.header.groundings.values():
        if not groundings:
            continue
        grounding = groundings[0]
        if grounding.rejected is not None:
            rejected.append(grounding)
        if grounding.winner is None:
            views_without += 1
        else:
            found.append(grounding)
            similarities.append(float(grounding.similarity[grounding.winner].mean()))
    margin = 0.0
    camera = ""
    disagreement = 0.0
    if found:
        narrowest = min(found, key=lambda grounding: grounding.ballot.margin)
        margin = narrowest.ballot.margin
        camera = narrowest.camera
        disagreement = max(similarities) - min(similarities)
    lost = []
    for frame in episode.frames:
        for event in frame.events:
            if is_lost(event):
                lost.append(event.frame_index)

    at = 0
    if rejected and not found:
        camera = rejected[0].camera
        sub_case = "not in view"
        sentence = f"{camera}: {describe_rejection(rejected[0])}, and no other view has it"
    elif not found:
        sub_case = "nothing found"
        sentence = "no view has a candidate"
    elif margin < NARROW:
        sub_case = "narrow vote"
        sentence = f"{camera}: the vote was won by {margin:.2f} of the references only"
    elif lost:
        sub_case = "lost track"
        at = lost[0]
        sentence = f"the target was lost {len(lost)} times, first at step {lost[0]}"
    else:
        sub_case = "no signal"
        at = episode.frames[-1].frame_index
        sentence = "votes and tracks give no sign of the cause"
    return Diagnosis(
        case="unlabelled",
        sub_case=sub_case,
        frame_index=at,
        camera="" if at else camera,
        evidence={
            "margin": margin,
            "lost": float(len(lost)),
            "disagreement": disagreement,
            "views_without": float(views_without),
        },
        confidence=0.0,
        sentence=sentence,
    )
