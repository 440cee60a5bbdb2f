"""Whether episodes can be done at all: the scripted expert, which reads the simulator, tries them.

For objects that nobody tried before: a scan of one's own can be too wide for a gripper, or too low.
"""

from collections.abc import Sequence

from vap_core.base.errors import BadStudy
from vap_core.base.types import value
from vap_core.evaluation.study import Study
from vap_core.policies.scripted.expert import Expert
from vap_core.rollout.loop import Trial, rollout
from vap_core.rollout.prompters.text import generic
from vap_core.simulation import suites
from vap_core.simulation.suites.open_row import build_scene, models_of
from vap_core.simulation.types import EpisodeRow


@value
class Tried:
    """How often the expert succeeds in a task, and the episodes in which it does not."""

    where: str
    n: int
    failed: tuple[str, ...]

    def __str__(self) -> str:
        succeeded = self.n - len(self.failed)
        text = f"{self.where}: the expert succeeds in {succeeded} of {self.n} episodes"
        if self.failed:
            text += f"; not in {', '.join(self.failed)}"
        return text


def feasible(rows: Sequence[EpisodeRow]) -> tuple[bool, ...]:
    """Whether the expert succeeds in each row; rows of one suite. About a second a row.

    Raises: UnknownName for a suite or an object that no registry holds.
    """
    succeeded: dict[int, bool] = {}
    for variant in dict.fromkeys(row.variant for row in rows):
        numbers = [i for i, row in enumerate(rows) if row.variant == variant]
        part = [rows[i] for i in numbers]
        for i, good in zip(numbers, _try_rows(part), strict=True):
            succeeded[i] = good
    return tuple(succeeded[i] for i in range(len(rows)))


def _try_rows(rows: Sequence[EpisodeRow]) -> list[bool]:
    """`feasible` for rows of one suite and variant."""
    suite = suites.suite(rows[0].suite)
    with build_scene(suite.name, models_of(rows), rows[0].variant) as scene:
        trial = Trial(
            method="generic",
            scene=scene,
            policy=Expert(),
            prompter=generic(),
            control=suite.control,
            sensor=suite.sensor,
            follow="call",
        )
        return [episode.outcome.success for episode in rollout(trial, rows)]


def check_feasible(study: Study) -> tuple[Tried, ...]:
    """The expert's successes in every task of a study.

    Raises: BadStudy where it succeeds in no episode of a task: then no policy can be blamed.
    """
    found = []
    for suite, task in study.tasks:
        rows = study.rows(suite, task)
        failed = []
        for row, good in zip(rows, feasible(rows), strict=True):
            if not good:
                failed.append(_name(row))
        tried = Tried(where=f"{suite}/{task}", n=len(rows), failed=tuple(failed))
        if len(failed) == len(rows):
            raise BadStudy(f"{tried}. {_remedy(study)}")
        found.append(tried)
    return tuple(found)


def _name(row: EpisodeRow) -> str:
    return f"{row.episode} (seed {row.seed})" if row.seed else str(row.episode)


def _remedy(study: Study) -> str:
    if study.object:
        return (
            f"{study.object} may be too wide or too low for the robot: import it with another "
            "--height-cm, or take a task that asks for a touch."
        )
    return "Leave the task out, or move its objects within the robot's reach."
