"""Following what was segmented at t = 0 through a video, every proposal under its own identity (P 3.3).

`cells` propagates labels over a grid of frozen features, `looks` remembers what an identity looks like, `state` is all that is known of one
view, and `lite` is the embedded tracker made of them.
"""

from functools import cache

from vap_core.embed import load as load_encoder
from vap_core.segment import load as load_segmenter
from vap_core.track.cells import Memory as Memory
from vap_core.track.cells import embed_cells as embed_cells
from vap_core.track.cells import propagate as propagate
from vap_core.track.cells import strongest as strongest
from vap_core.track.cells import to_cells as to_cells
from vap_core.track.cells import to_pixels as to_pixels
from vap_core.track.lite import LiteTracker as LiteTracker
from vap_core.track.protocol import Tracker as Tracker
from vap_core.track.state import RECENT as RECENT
from vap_core.track.state import TrackState as TrackState


@cache
def load() -> LiteTracker:
    """The shipped tracker, with the shipped segmenter and encoder."""
    return LiteTracker(load_segmenter(), load_encoder())
