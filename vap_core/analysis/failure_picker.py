"""Failures in a notebook: pick one, open its recording at the frame that decided it, label it.

    picker = FailurePicker(list_failures(TABLE, method="vap"), Path("data/runs/labels.csv"))

Labels are what a person concluded, beside the diagnosis; they change no table and no recording.
"""

import csv
from datetime import UTC, datetime
from html import escape
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.analysis.controls import ALL, Control
from vap_core.base.errors import BadOutput
from vap_core.base.extras import require
from vap_core.base.files import write_atomic, writing
from vap_core.evaluation.diagnosis.failures import Failures, failure_row
from vap_core.evaluation.diagnosis.recordings import recording_to_show
from vap_core.rollout.failure import CASES

if TYPE_CHECKING:
    import pandas as pd

KEY = ("suite", "task", "episode", "seed", "method", "policy")
"""The columns that name a labelled episode."""
LABELS = (*KEY, "case", "sub_case", "diagnosed_case", "diagnosed_sub_case", "note", "at")
"""The columns of the file of labels."""


def read_labels(path: Path) -> "pd.DataFrame":
    """Every label of a file, the last of each episode. Raises: BadOutput where it is damaged."""
    import pandas as pd

    if not path.exists() or path.stat().st_size == 0:
        return pd.DataFrame(columns=list(LABELS))
    try:
        found = pd.read_csv(path, keep_default_na=False)
    except (OSError, ValueError) as error:
        raise BadOutput(f"read_labels: {path} is damaged ({error}); mend or delete it.") from error
    if list(found.columns) != list(LABELS):
        raise BadOutput(f"read_labels: {path} has other columns than labels; name another file.")
    return found.drop_duplicates(list(KEY), keep="last").reset_index(drop=True)


def write_label(path: Path, row: dict[str, Any], label: str, note: str = "") -> None:
    """Add a person's label of a failure, to "case 3: slip" for example; earlier ones are kept.

    Raises: BadOutput for a label that is no case, or a file that cannot be written.
    """
    if label not in label_names():
        raise BadOutput(f"write_label: {label!r} is no case; choose one of label_names().")
    case, _, sub_case = label.partition(": ")
    line = {name: row[name] for name in KEY} | {
        "case": case,
        "sub_case": sub_case,
        "diagnosed_case": row["case"],
        "diagnosed_sub_case": row["sub_case"],
        "note": note,
        "at": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    text = StringIO()
    writer = csv.DictWriter(text, LABELS)
    with writing(path, "write_label", "make room, or name another file"):
        path.parent.mkdir(parents=True, exist_ok=True)
        before = path.read_bytes() if path.exists() else b""
        if not before:
            writer.writeheader()
        elif not before.endswith(b"\n"):  # a program or a person left the last line open
            before += b"\n"
        writer.writerow(line)
        write_atomic(path, before + text.getvalue().encode())


def label_names() -> list[str]:
    """Every label that a failure can have: case and sub-case."""
    names = []
    for case, sub_cases in CASES.items():
        names += [f"{case}: {sub_case}" for sub_case in sub_cases]
    return names


class FailurePicker(Control):
    """Pick a failure, open it, label it. The first one stands as words where there is no kernel.

    Raises: MissingPart: the extra `notebooks` is not installed.
    """

    def __init__(self, failures: Failures, labels: Path) -> None:
        require("notebooks", "a control")
        import ipywidgets

        self.failures, self.labels = failures, labels
        table = failures.table
        suites = [ALL, *dict.fromkeys(table["suite"])]
        cases = [ALL, *sorted(set(table["case"]))]
        self.suite = ipywidgets.Dropdown(options=suites, value=ALL, description="suite")
        self.case = ipywidgets.Dropdown(options=cases, value=ALL, description="case")
        self.failure = ipywidgets.Dropdown(description="failure", layout={"width": "640px"})
        self.why = ipywidgets.HTML()
        self.open = ipywidgets.Button(description="open", tooltip="runs it again if need be")
        self.label = ipywidgets.Dropdown(options=label_names(), description="label")
        self.note = ipywidgets.Text(placeholder="why", description="note")
        self.keep = ipywidgets.Button(description="keep label")
        self.said = ipywidgets.HTML()
        self.shown = ipywidgets.Output()
        self._list()
        self.suite.observe(lambda _: self._list(), names="value")
        self.case.observe(lambda _: self._list(), names="value")
        self.failure.observe(lambda _: self._tell(), names="value")
        self.open.on_click(lambda _: self.show())
        self.keep.on_click(lambda _: self._keep())
        rows = [
            ipywidgets.HBox([self.suite, self.case, self.failure]),
            self.why,
            ipywidgets.HBox([self.open, self.label, self.note, self.keep]),
            self.said,
            self.shown,
        ]
        words = "no failures"
        if len(table):
            first = table.iloc[0].to_dict()
            words = f"{_name(first)}: {first['case_sentence']} · in JupyterLab: pick, open, label."
        super().__init__(ipywidgets.VBox(rows), words)

    @property
    def row(self) -> dict[str, Any]:
        """The picked failure's line of the table."""
        return failure_row(self.failures, self.failure.value)

    def viewer(self) -> Any:
        """Rerun's viewer with the picked failure's recording at its deciding frame.

        Raises: as `recording_to_show` and `view`.
        """
        from vap_core.recording import view

        path, frame = recording_to_show(self.failures, self.failure.value)
        viewer = view(path)
        viewer.set_time_ctrl(sequence=frame, timeline="frame_index", play=False)
        return viewer

    def show(self) -> None:
        """Put the viewer below the controls."""
        from IPython.display import display

        self.shown.clear_output()
        with self.shown:
            display(self.viewer())

    def _list(self) -> None:
        """The failures of the chosen suite and case."""
        table = self.failures.table
        for column, wanted in (("suite", self.suite.value), ("case", self.case.value)):
            if wanted != ALL:
                table = table[table[column] == wanted]
        options = []
        for number, row in zip(table.index, table.to_dict("records"), strict=True):
            options.append((f"#{number} {_name(row)}", int(number)))
        self.failure.options = options
        self.failure.index = 0 if options else None
        self._tell()

    def _tell(self) -> None:
        if self.failure.value is None:
            self.why.value = "no failure of this kind"
            return
        row = self.row
        self.label.value = f"{row['case']}: {row['sub_case']}"
        self.why.value = escape(str(row["case_sentence"]))

    def _keep(self) -> None:
        write_label(self.labels, self.row, self.label.value, self.note.value)
        found = read_labels(self.labels)
        is_same = found["case"].eq(found["diagnosed_case"])
        same = (is_same & found["sub_case"].eq(found["diagnosed_sub_case"])).sum()
        file = escape(self.labels.name)
        self.said.value = f"{len(found)} labelled in {file}, {same} as diagnosed"


def _name(row: dict[str, Any]) -> str:
    where = f"{row['suite']} {row['task']} {row['episode']}"
    return f"{where}, {row['case']}: {row['sub_case']}"
