"""What policies tell of themselves while they plan, to whom asks: by episode of the batch, then by name. Nobody asking costs nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class Ear[T]:
    """One kind of thing that is told. What is told first of an episode and a name stands."""

    def __init__(self, name: str) -> None:
        self._told: ContextVar[dict[int, dict[str, T]] | None] = ContextVar(name, default=None)

    @contextmanager
    def open(self) -> Iterator[dict[int, dict[str, T]]]:
        """Collect what is told inside the block."""
        found: dict[int, dict[str, T]] = {}
        token = self._told.set(found)
        try:
            yield found
        finally:
            self._told.reset(token)

    def opened(self) -> bool:
        """Whether anybody listens: what is costly to gather is gathered then only."""
        return self._told.get() is not None

    def tell(self, episode: int, name: str, thing: T) -> None:
        """Say it of episode number `episode` of the batch."""
        told = self._told.get()
        if told is not None:
            told.setdefault(episode, {}).setdefault(name, thing)
