"""The queries whose attention is observed.

They are the learned token, the colour word, the category word, and the action expert's tokens.
"""

from collections.abc import Mapping, Sequence

from vap_core.base.errors import one_of
from vap_core.policies.hooks import ACTION, AttentionMap, Phrases
from vap_core.policies.mini_pi0.learned_token import WORD
from vap_core.prompt import PALETTE
from vap_core.simulation.types import EpisodeRow

TOKEN = "token"
COLOUR = "colour"
CATEGORY = "category"
QUERIES = (TOKEN, COLOUR, CATEGORY, ACTION)
ALL = "all"


def query_phrases(row: EpisodeRow) -> Phrases:
    """The words of every query in one episode; a text that lacks them has no such query."""
    colours = tuple(colour.name for colour in PALETTE)
    return {TOKEN: (WORD,), COLOUR: colours, CATEGORY: (row.category,)}


def only_queries(
    maps: Mapping[str, Mapping[str, AttentionMap]], wanted: Sequence[str]
) -> dict[str, dict[str, AttentionMap]]:
    """The maps of the wanted queries, by camera; empty where the text has none of them."""
    kept: dict[str, dict[str, AttentionMap]] = {}
    for camera, of_queries in maps.items():
        for query, heat in of_queries.items():
            if query in wanted:
                kept.setdefault(camera, {})[query] = heat
    return kept


def named_queries(names: Sequence[str]) -> tuple[str, ...]:
    """The queries that are named, in the order of QUERIES; "all" names every one.

    Raises: UnknownName.
    """
    for name in names:
        if name not in (*QUERIES, ALL):
            raise one_of("--attention: query", name, [*QUERIES, ALL])
    if ALL in names:
        return QUERIES
    return tuple(query for query in QUERIES if query in names)
