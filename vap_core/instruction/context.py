"""Whom "my", "Anna's" and "my brother's" mean.

An object belongs to the person that it was registered for (`register --owner anna`), or to nobody
in particular. The rule, in this order:

1. In a memory without any owner, the owner in an instruction is not looked at.
2. "my cup" is a cup of the speaker's (`--speaker anna`); where she has none, a cup without an
   owner. It is never another person's. Without a speaker it is a cup without an owner.
3. "our cup" is a cup without an owner.
4. "Anna's cup" is a cup of the owner called anna, upper and lower case alike.
5. "my brother's cup" is a cup of the owner who is known as "brother" or, when Anna speaks, as
   "Anna's brother" (`register --owner ben --known-as "anna's brother"`). "Anna's brother's cup" is
   one of whoever is known as "Anna's brother"; where nobody is, as "brother". "my friend's
   brother's cup" needs somebody who is known as "friend's brother" or, when Anna speaks, as "Anna's
   friend's brother".
6. "his", "her" and "their cup" are a cup of the only other person who has one.

An owner that nobody has, and words that fit several people, are errors.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from unicodedata import normalize

from vap_core.base.errors import BadInstruction, BadMemory, UnknownName
from vap_core.base.files import folder_locked, parse_json, read_file, write_atomic, writing
from vap_core.base.types import PersonalObject, value

PERSON = re.compile(r"[^\W\d_][^\W\d_ .'’-]*(?:[ .'’-]+[^\W\d_]+){0,4}\.?")
MAX_NOTE = 200
"""Characters of a note."""
MINE = ("my", "mine", "my own", "i", "me")
OURS = ("our", "ours", "us", "we")
OTHERS = ("his", "her", "hers", "their", "theirs", "he", "she", "they", "him", "them")


def check_owner(owner: str, known_as: Sequence[str], note: str) -> None:
    """Raises: BadMemory: no usable owner, other word for one, or note."""
    for word in (owner, *known_as):
        if word and not PERSON.fullmatch(normalize("NFC", word)):
            raise BadMemory(
                f"remember: {word[:64]!r} cannot be a person; use letters, spaces and 's, for "
                'example --owner anna, or --known-as "anna\'s brother".'
            )
    if known_as and not owner:
        raise BadMemory("remember: --known-as is another word for the owner; name one by --owner.")
    if len(note) > MAX_NOTE or not note.isprintable():
        raise BadMemory(
            f"remember: a note is one line of at most {MAX_NOTE} characters; shorten it."
        )


def owners_of(objects: Iterable[PersonalObject]) -> dict[str, tuple[str, ...]]:
    """Every owner, and the other words for that person, lower case."""
    owners: dict[str, tuple[str, ...]] = {}
    for obj in objects:
        if obj.owner:
            known = owners.get(fold(obj.owner), ())
            further = tuple(fold(word) for word in obj.known_as)
            owners[fold(obj.owner)] = tuple(dict.fromkeys(known + further))
    return owners


def belonging(
    objects: Sequence[PersonalObject],
    owner: str,
    speaker: str,
    owners: dict[str, tuple[str, ...]],
) -> list[PersonalObject]:
    """Those of `objects` that `owner` ("my", "Anna's", "my brother's") means when `speaker` speaks.

    `owners` are all of the memory (`owners_of`).

    Raises: UnknownName: an owner whom nobody is; BadInstruction: it could be several people.
    """
    if not owners:
        return list(objects)
    person = fold(owner)
    if person in MINE:
        own = _owned_by(objects, fold(speaker)) if speaker else []
        return own or _owned_by(objects, "")
    if person in OURS:
        return _owned_by(objects, "")
    if person in OTHERS:
        # The only person besides the speaker who owns one of `objects`.
        people = sorted({fold(obj.owner) for obj in objects} - {"", fold(speaker)})
        if len(people) > 1:
            raise BadInstruction(
                f"owners: {person!r} could be {' or '.join(people)}; say the name, for example "
                f'"{people[0]}\'s".'
            )
        return _owned_by(objects, people[0]) if people else []
    return _owned_by(objects, find_owner(person, speaker, owners))


def find_owner(person: str, speaker: str, owners: dict[str, tuple[str, ...]]) -> str:
    """The owner that "anna", "my brother" or "anna's brother" means.

    The speaker's own relation comes first, then all the words, then the last one. Only "anna's
    brother", all of it, can be the speaker. Of "my friend's brother" the last word alone is nobody.

    Raises: UnknownName, BadInstruction.
    """
    person = fold(person)
    if person in owners:
        return person
    relation = person.removeprefix("my ")
    speaker = fold(speaker)
    words = [relation]
    # By how many people a person is named: 2 for "my friend's brother", 0 for "anna".
    first = person.split()[0] in (*MINE, *OURS, *OTHERS)
    if first + len(re.findall(r"(?:'s|s') ", person)) < 2:
        words.append(relation.split()[-1])
    mine = [f"{speaker}'s {word}" for word in words if person.startswith("my ") and speaker]
    for wanted in (mine, [person], words):
        self_too = wanted == [person] and "'s " in person
        found = [
            name
            for name, known_as in owners.items()
            if (name != speaker or self_too) and ({name, *known_as} & set(wanted))
        ]
        if len(found) == 1:
            return found[0]
        if found:
            raise BadInstruction(
                f"owners: {person!r} could be {' or '.join(found)}; say the name, for example "
                f'"{found[0]}\'s".'
            )
    raise UnknownName(
        f"owners: nobody is {person!r}; the memory knows {describe(owners)}. Register an object "
        "with --owner, or say --known-as."
    )


def describe(owners: dict[str, tuple[str, ...]]) -> str:
    """ "anna, ben (brother)", for an error."""
    names = [
        f"{name} ({', '.join(known_as)})" if known_as else name
        for name, known_as in sorted(owners.items())
    ]
    return ", ".join(names)


def fold(person: str) -> str:
    """A person's words without case, with single spaces, and without the final 's.

    An umlaut of two characters, as macOS writes it, is one.
    """
    words = " ".join(normalize("NFC", person).lower().replace("’", "'").split())
    return re.sub(r"('s|(?<=s)')$", "", words)


def _owned_by(objects: Sequence[PersonalObject], owner: str) -> list[PersonalObject]:
    return [obj for obj in objects if fold(obj.owner) == owner]


FILE = "history.jsonl"
MAX_USES = 1000
"""So many uses are read, the last ones."""


@value
class Use:
    """One object that was asked for: by whom ("" where nobody said), and when (ISO 8601)."""

    object: str
    by: str
    at: str

    def __post_init__(self) -> None:
        datetime.fromisoformat(self.at)


def read_uses(bank: Path) -> tuple[Use, ...]:
    """The uses that a memory keeps, oldest first; none where there is no history yet.

    Raises: BadMemory: it cannot be read, or a line is damaged.
    """
    path = bank / FILE
    uses = []
    try:
        for line in _lines(path)[-MAX_USES:]:
            row = parse_json(line.decode("utf-8"))
            uses.append(Use(object=row["object"], by=row["by"], at=row["at"]))
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except OSError as error:
        raise BadMemory(
            f"history: {path} cannot be read ({error.strerror or error}); check its permissions, "
            "or choose another folder with --memory."
        ) from error
    except (ValueError, KeyError, TypeError) as error:
        raise BadMemory(
            f"history: {path} is damaged ({type(error).__name__}); delete it to start a new one."
        ) from error
    return tuple(uses)


def add_uses(bank: Path, objects: Sequence[str], by: str, at: datetime) -> None:
    """Add one use per object; the last MAX_USES uses are kept. Raises: BadOutput."""
    if not objects:
        return
    about = {"by": by, "at": at.isoformat(timespec="seconds")}
    rows = [{"object": name, **about} for name in objects]
    added = [json.dumps(row, ensure_ascii=False).encode("utf-8") for row in rows]
    path = bank / FILE
    with writing(bank, "history", "choose another folder with --memory"):
        bank.mkdir(parents=True, exist_ok=True)
        with folder_locked(bank):
            lines = _lines(path) if path.exists() else []
            write_atomic(path, b"".join(line + b"\n" for line in [*lines, *added][-MAX_USES:]))


def _lines(path: Path) -> list[bytes]:
    """The lines of a history; not one without an end, of which the writing failed.

    Raises: OSError.
    """
    *lines, _ = read_file(path).split(b"\n")
    return [line for line in lines if line.strip()]


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

        def fits(use: Use) -> bool:
            used = datetime.fromisoformat(use.at)
            days = ((self.now or datetime.now(used.tzinfo)).date() - used.date()).days
            return use.object in self.objects and by in (None, fold(use.by)) and day in (None, days)

        return list(dict.fromkeys(use.object for use in reversed(self.uses) if fits(use)))
