"""Episode -> .rrd: the recording, its layout, reading it back and looking at it.

Nothing outside this folder imports rerun; importing this folder does.
"""

from pathlib import Path

from vap_core.recording import show
from vap_core.recording.clips import ClipRecorder as ClipRecorder
from vap_core.recording.clips import ClipStep as ClipStep
from vap_core.recording.clips import DatasetRecorder as DatasetRecorder
from vap_core.recording.clips import record_grounding as record_grounding
from vap_core.recording.read import read_chunks as read_chunks
from vap_core.recording.read import read_summary as read_summary
from vap_core.recording.recorder import DeferredRecorder as DeferredRecorder
from vap_core.recording.recorder import Recorder as Recorder
from vap_core.recording.recorder import is_failure_or_sampled as is_failure_or_sampled
from vap_core.recording.show import combine_recordings as combine_recordings
from vap_core.recording.show import open_viewer as open_viewer
from vap_core.recording.show import rerun_version as rerun_version
from vap_core.recording.show import view as view
from vap_core.recording.show import write_film as write_film
from vap_core.recording.stream import recording_file_name as recording_file_name
from vap_core.recording.stream import recording_name as recording_name
from vap_core.recording.stream import recover as recover


def screenshot(
    rrd: Path, png: Path, *, frame_index: int | None = None, size: tuple[int, int] = (1600, 1000)
) -> None:
    """`show.screenshot`, once a driver is there: a viewer would start, and fail later.

    Raises: as it does.
    """
    show.check_viewer(window=False, picture=True)
    show.screenshot(rrd, png, frame_index=frame_index, size=size)
