"""Following through a video what was segmented at t = 0, every proposal as an identity (P 3.3).

`cells` propagates labels over a grid of frozen features, `components` turns planes of shares into
masks, `appearance` compares colours and crops, `state` is what is remembered of one view, `update`
decides which masks are believed, `search` looks for lost identities, and `tracker` joins them.
"""

from functools import cache

from vap_core.perception.embedded.encoder import load as load_encoder
from vap_core.perception.embedded.networks import (
    PERCEPTION,
    load_network,
    read_manifest,
    trunk_weights,
)
from vap_core.perception.embedded.segmenter import load as load_segmenter
from vap_core.perception.embedded.tracker.cells import GRAPH, TAP
from vap_core.perception.embedded.tracker.tracker import LiteTracker


@cache
def load() -> LiteTracker:
    """The shipped tracker, with the shipped segmenter and encoder.

    Raises: MissingWeights: a file of data/weights is absent or damaged.
    """
    sha256 = read_manifest()[PERCEPTION]["sha256"]
    network = load_network(GRAPH, trunk_weights([TAP]), sha256)
    return LiteTracker(network, load_segmenter(), load_encoder())
