"""Episode -> .rrd: the recording, its blueprint, reading it back and looking at it. Nothing outside this room imports rerun."""

from vap_core.record.file import read_summary as read_summary
from vap_core.record.file import recording_name as recording_name
from vap_core.record.file import recover as recover
from vap_core.record.keep import Waiting as Waiting
from vap_core.record.keep import wanted as wanted
from vap_core.record.recorder import Recorder as Recorder
from vap_core.record.recorder import record_grounding as record_grounding
from vap_core.record.viewer import open_viewer as open_viewer
from vap_core.record.viewer import screenshot as screenshot
from vap_core.record.viewer import view as view
