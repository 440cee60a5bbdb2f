"""What a researcher concluded of failures: a small table in the folder of their recordings."""

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vap_core.base.errors import BadOutput, BadStudy, one_of
from vap_core.base.files import write_atomic, writing
from vap_core.evaluation.store import KEY
from vap_core.rollout.failure import CASES

if TYPE_CHECKING:
    import pandas as pd

FILE = "corrections.csv"
NAMED = [*KEY, "policy"]
CORRECTED = ["case", "sub_case", "case_sentence"]


def parse_case(text: str) -> tuple[str, str]:
    """Case and sub-case of "case 3: slip". Raises: UnknownName."""
    case, _, sub_case = (part.strip() for part in text.partition(":"))
    if case not in CASES:
        raise one_of("correct: case", case, CASES)
    if sub_case not in CASES[case]:
        raise one_of(f"correct: sub-case of {case}", sub_case, CASES[case])
    return case, sub_case


def correct(folder: Path, row: Mapping[str, Any], text: str, note: str = "") -> Path:
    """Correct the case of a failure, in place of an earlier correction; returns the table.

    Raises: UnknownName for what is no case; BadStudy for an episode that did not fail; BadOutput.
    """
    import pandas as pd

    case, sub_case = parse_case(text)
    if row["outcome"] != "failure":
        raise BadStudy(f"correct: it ended in {row['outcome']}; only failures have a case.")
    new = {**{name: row[name] for name in NAMED}, "case": case, "sub_case": sub_case}
    new["case_sentence"] = note or f"corrected to {case}, {sub_case}"
    table = pd.concat([read(folder), pd.DataFrame([new])]).drop_duplicates(NAMED, keep="last")
    path = folder / FILE
    with writing(path, "correct", "copy the run to where you may write"):
        folder.mkdir(parents=True, exist_ok=True)
        write_atomic(path, table.to_csv(index=False).encode())
    return path


def read(folder: Path) -> "pd.DataFrame":
    """The corrections in a folder, the last of each episode. Raises: BadOutput."""
    import pandas as pd

    path = folder / FILE
    if not path.exists():
        return pd.DataFrame(columns=[*NAMED, *CORRECTED])
    try:
        table = pd.read_csv(path, keep_default_na=False)[[*NAMED, *CORRECTED]]
    except (OSError, ValueError, KeyError) as error:
        raise BadOutput(
            f"corrections: {path} is damaged ({error}); mend it, or delete it and correct again."
        ) from error
    return table


def with_corrections(table: "pd.DataFrame") -> "pd.DataFrame":
    """The failures of a table as corrected in their `folder`, marked in the column `corrected`."""
    table = table.assign(corrected=False)
    if "case" not in table or "policy" not in table:
        return table
    for folder, part in table[table["outcome"].eq("failure")].groupby("folder", sort=False):
        found = read(Path(str(folder))).set_index(NAMED)[CORRECTED]
        for index, name in zip(part.index, part[NAMED].itertuples(index=False), strict=True):
            if tuple(name) in found.index:
                table.loc[index, CORRECTED] = found.loc[[tuple(name)]].iloc[-1]
                table.loc[index, ["case_confidence", "corrected"]] = [1.0, True]
    return table
