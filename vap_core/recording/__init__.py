"""Episode -> .rrd: the recording, its layout, reading it back and looking at it.

Nothing outside this folder imports rerun; importing this folder does.
"""

import os

# Read when rerun is imported: its catalog warns about every name with a dot in it.
os.environ.setdefault("RUST_LOG", "error")

from vap_core.recording.browser import serve_run as serve_run
from vap_core.recording.catalog import load_steps as load_steps
from vap_core.recording.clicks import Votes as Votes
from vap_core.recording.clicks import inspect_votes as inspect_votes
from vap_core.recording.corrections import Correction as Correction
from vap_core.recording.corrections import read_corrections as read_corrections
from vap_core.recording.corrections import write_correction as write_correction
from vap_core.recording.dataset import DatasetRecorder as DatasetRecorder
from vap_core.recording.deferred import DeferredRecorder as DeferredRecorder
from vap_core.recording.deferred import is_failure_or_sampled as is_failure_or_sampled
from vap_core.recording.file import recording_file_name as recording_file_name
from vap_core.recording.file import recording_name as recording_name
from vap_core.recording.file import recover as recover
from vap_core.recording.film import write_film as write_film
from vap_core.recording.grounding import ClipRecorder as ClipRecorder
from vap_core.recording.grounding import ClipStep as ClipStep
from vap_core.recording.grounding import record_grounding as record_grounding
from vap_core.recording.index import ensure_index as ensure_index
from vap_core.recording.isolated import check_recording as check_recording
from vap_core.recording.query import format_result as format_result
from vap_core.recording.query import run_query as run_query
from vap_core.recording.reading import read_chunks as read_chunks
from vap_core.recording.reading import read_summary as read_summary
from vap_core.recording.recorder import Recorder as Recorder
from vap_core.recording.side_by_side import combine_recordings as combine_recordings
from vap_core.recording.viewer import open_viewer as open_viewer
from vap_core.recording.viewer import rerun_version as rerun_version
from vap_core.recording.viewer import screenshot as screenshot
from vap_core.recording.viewer import view as view
