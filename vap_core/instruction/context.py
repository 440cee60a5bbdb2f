"""What a parser may know besides the text."""

from collections.abc import Mapping
from datetime import datetime

from vap_core.base.types import PersonalObject, value
from vap_core.instruction.history import Use
from vap_core.instruction.owners import fold, owners_of


@value
class Context:
    """The memory, who speaks ("" where nobody said), what was used before, and the time."""

    objects: Mapping[str, PersonalObject]
    speaker: str = ""
    uses: tuple[Use, ...] = ()
    now: datetime | None = None

    @property
    def owners(self) -> dict[str, tuple[str, ...]]:
        """Every owner of the memory, with the other words for that person."""
        return owners_of(self.objects.values())

    def latest(self, by: str | None = None, day: int | None = None) -> list[str]:
        """Names of the objects that were used, the last one first.

        `by` is one person, None for anybody; `day` counts back from today, None for any day.
        """
        names = []
        for use in reversed(self.uses):
            if use.object not in self.objects or (by is not None and fold(use.by) != by):
                continue
            if day is not None and self._days_ago(use) != day:
                continue
            names.append(use.object)
        return list(dict.fromkeys(names))

    def _days_ago(self, use: Use) -> int:
        used = datetime.fromisoformat(use.at)
        now = self.now or datetime.now(used.tzinfo)
        return (now.date() - used.date()).days
