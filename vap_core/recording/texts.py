"""Text in a recording: the outcome, the diagnosis, the instruction pane."""

import rerun as rr

from vap_core.base.pictures import LEGEND, object_labels, result_line
from vap_core.base.types import Grounding, PersonalObject
from vap_core.rollout.types import Diagnosis, EpisodeHeader
from vap_core.simulation.types import EpisodeRow, Outcome


def describe_outcome(outcome: Outcome) -> str:
    """How an episode ended, such as "failure, 60 steps, moved a wrong object"."""
    parts = [outcome.status, f"{outcome.steps} steps"]
    if outcome.wrong_object:
        parts.append("moved a wrong object")
    if outcome.detail:
        parts.append(outcome.detail)
    return ", ".join(parts)


DONE = {"picked": "picked", "near": "moved", "put": "placed", "selected": "selected"}
"""What a success did, by the rule of the task."""
CAUSES = {
    "case 1": "wrong mask (Case 1): ",
    "case 2": "views disagree (Case 2): ",
    "case 3": "right prompt, failed hand (Case 3): ",
    "unprompted": "unprompted: ",
}


def verdict_line(header: EpisodeHeader, outcome: Outcome, diagnosis: Diagnosis | None) -> str:
    """How an episode ended, such as "SUCCESS · picked your cup in 37 steps · "pick up my cup""."""
    row = header.row
    parts = [outcome.status.upper()]
    if diagnosis is not None:
        shown = _tinted(diagnosis, row.target)
        cause = CAUSES.get(diagnosis.case, "")
        parts.append(cause + _plain(header, shown or diagnosis.sentence))
    elif outcome.success:
        done = f"{DONE[row.rule]} your {row.category}" if row.rule in DONE else "done"
        parts.append(f"{done} in {outcome.steps} steps")
    else:
        parts += filter(None, [f"{outcome.steps} steps", outcome.detail])
    return " · ".join([*parts, f'"{header.rewritten}"'])


def verdict_document(
    header: EpisodeHeader, outcome: Outcome, diagnosis: Diagnosis | None
) -> rr.TextDocument:
    """The verdict as a heading; below it why, who it was, and of what episode."""
    row = header.row
    policy = header.policy.rpartition(":")[2].partition("@")[0]
    about = [header.method, policy, f"{row.suite} {row.task} {row.episode}"]
    if diagnosis is not None:
        about.insert(0, f"decided at step {diagnosis.frame_index}")
        if diagnosis.case == "case 1":
            about.insert(0, _plain(header, diagnosis.sentence.partition(";")[0]))
    return _markdown(f"### {verdict_line(header, outcome, diagnosis)}\n\n{' · '.join(about)}")


def _plain(header: EpisodeHeader, text: str) -> str:
    """A text with every object called as the pictures call it."""
    labels = object_labels(list(header.object_sizes_m), header.row.target)
    for name in sorted(labels, key=len, reverse=True):
        text = text.replace(name, labels[name])
    return text


def instruction_document(header: EpisodeHeader, outcome: str = "") -> rr.TextDocument:
    """The instruction and its rewrite, how the episode ended, the colours."""
    row = header.row
    lines = [f'**said** "{header.instruction}"']
    if row.owned:
        lines.append(f"**by** {row.speaker} · {_owners(row)}")
    if header.rewritten != header.instruction:
        lines.append(f'**policy read** "{header.rewritten}"')
    else:
        lines.append("**policy read** the same words")
    if outcome:
        lines.append(f"**ended** {outcome}")
    lines.append(
        f"{row.suite} · {row.task} · episode {row.episode} · seed {row.seed} · "
        f"{header.method} · {header.policy}"
    )
    lines.append(f"*{LEGEND}*")
    return _markdown("  \n".join(lines))


def _tinted(diagnosis: Diagnosis, target: str) -> str:
    """What every view tints, views of one thing together and those of the target last."""
    views: dict[str, list[str]] = {}
    for name, label in diagnosis.evidence.items():
        if name.startswith("shows_"):
            views.setdefault(str(label), []).append(name.removeprefix("shows_"))
    parts = []
    for label in sorted(views, key=lambda label: label == target):
        thing = "no object" if label.startswith("nothing in ") else label
        *names, last = views[label]
        verb = "tint" if names else "tints"
        parts.append(f"{' and '.join([*filter(None, [', '.join(names)]), last])} {verb} {thing}")
    return ", ".join(parts)


def grounding_document(
    grounding: Grounding, obj: PersonalObject, instruction: str, rewritten: str
) -> rr.TextDocument:
    """The instruction, its rewrite, the vote and the object of one grounded picture."""
    lines = [
        f'**said** "{instruction}"',
        f'**policy reads** "{rewritten}"',
        result_line(grounding),
        f"{obj.name} · {obj.category} · {len(obj.crops)} references · {obj.encoder}",
    ]
    return _markdown("\n\n".join(lines))


def _owners(row: EpisodeRow) -> str:
    """ "anna's camera-personal, ben's (anna's brother) camera-lookalike-5"."""
    parts = []
    for owned in row.owned:
        known = f" ({', '.join(owned.known_as)})" if owned.known_as else ""
        parts.append(f"{owned.owner}'s{known} {owned.model}")
    return ", ".join(parts)


def _markdown(text: str) -> rr.TextDocument:
    return rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN)
