"""Episode -> .rrd: the recording, its blueprint, reading it back and looking at it. Nothing outside this room imports rerun."""

import os

os.environ.setdefault("RUST_LOG", "error")  # read when rerun is imported: its catalog warns about every name with a dot in it

from vap_core.record.catalog import steps as steps
from vap_core.record.file import file_name as file_name
from vap_core.record.file import read_summary as read_summary
from vap_core.record.file import recording_name as recording_name
from vap_core.record.file import recover as recover
from vap_core.record.index import index as index
from vap_core.record.keep import Waiting as Waiting
from vap_core.record.keep import wanted as wanted
from vap_core.record.layers import Correction as Correction
from vap_core.record.layers import correct as correct
from vap_core.record.layers import corrections as corrections
from vap_core.record.recorder import Recorder as Recorder
from vap_core.record.recorder import record_grounding as record_grounding
from vap_core.record.together import together as together
from vap_core.record.viewer import open_viewer as open_viewer
from vap_core.record.viewer import screenshot as screenshot
from vap_core.record.viewer import view as view
