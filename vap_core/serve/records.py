"""What a proxy's episodes leave behind: a line each, and with a folder recordings and tables."""

import re
import sys
import threading
import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from vap_core.base.errors import first_line, printable
from vap_core.base.types import Attended, PersonalObject
from vap_core.recording import DatasetRecorder, recording_file_name
from vap_core.serve.proxy import Keeper, Prompted, events_of
from vap_core.study import store
from vap_core.study.steps import FOLDER

SUITE = "served"
UNKNOWN = "unknown"
"""How an episode ended: no wire says it before its end, and openpi's never does."""


class Episode:
    """One episode under way."""

    def __init__(self, found: Prompted) -> None:
        self.first = found
        self.began = time.monotonic()
        self.recorder: DatasetRecorder | None = None
        self.steps: list[dict[str, Any]] = []
        self.added_ms: list[float] = []
        self.waited_ms: list[float] = []
        self.at_s: list[float] = []


class Records(Keeper):
    """Prints a line for every episode; `folder` is a run's, with recordings, steps and episodes.

    Raises: BadOutput: the folder holds something else.
    """

    def __init__(
        self, folder: Path | None, bank: Mapping[str, PersonalObject], about: Mapping[str, Any]
    ) -> None:
        self._folder = None if folder is None else store.open_run(folder, about)
        self._before = 0 if folder is None else len(store.read(folder))
        """Episodes of the folder that an earlier server wrote."""
        self._bank = bank
        self._method = str(about["method"])
        self._upstream = str(about["policy"])
        self._under_way: dict[object, Episode] = {}
        self._lock = threading.Lock()
        self._failed = False

    def observed(self, stream: object, found: Prompted) -> None:
        text = printable(found.attended.text)
        attended = replace(found.attended, text=text)
        found = replace(found, instruction=printable(found.instruction), attended=attended)
        with self._lock:
            episode = self._under_way.get(stream)
            if episode is None or episode.first.episode != found.episode:
                self._end(stream)
                episode = self._under_way[stream] = Episode(found)
                self._tell_start(found)
            try:
                self._keep(episode, found)
            except Exception as error:  # what cannot be recorded ends no client's episode
                self._give_up(error)

    def answered(self, stream: object, actions: np.ndarray | None, seconds: float) -> None:
        with self._lock:
            episode = self._under_way.get(stream)
            if episode is None:
                return
            episode.waited_ms.append(1e3 * seconds)
            call = len(episode.waited_ms) - 1
            if episode.recorder is not None and actions is not None and not self._failed:
                at_s = episode.at_s[min(call, len(episode.at_s) - 1)]
                try:
                    row = actions.reshape(len(actions), -1)[0].astype(np.float64)
                    episode.recorder.add_numbers(call, at_s, {"/action": row}, ())
                except Exception as error:
                    self._give_up(error)

    def ended(self, stream: object) -> None:
        with self._lock:
            self._end(stream)

    def _tell_start(self, found: Prompted) -> None:
        shown = self._found_in(found.attended)
        text = f"{found.instruction!r:.100}"
        if found.attended.text != found.instruction:
            text += f" -> {found.attended.text!r:.100}"
        elif not any(found.attended.groundings.values()):
            text += " (nothing personal: passed as it is)" if self._method != "dry" else ""
        _say(f"episode {found.episode}: {text}; {shown}starts: {found.starts}")

    def _found_in(self, attended: Attended) -> str:
        parts = []
        for camera, of_targets in attended.groundings.items():
            seen = [grounding.winner is not None for grounding in of_targets]
            parts.append(f"{camera} {'yes' if all(seen) else 'not in view'}")
        return f"{', '.join(parts)}; " if parts else ""

    def _keep(self, episode: Episode, found: Prompted) -> None:
        episode.added_ms.append(1e3 * sum(found.seconds.values()))
        at_s = time.monotonic() - episode.began if found.call else 0.0
        episode.at_s.append(at_s)
        attended = found.attended
        for camera in found.views:
            groundings = attended.groundings.get(camera, ())
            held = [g.ballot.margin for g in groundings[:1] if g.ballot.winner is not None]
            episode.steps.append(
                {
                    **self._key(episode.first),
                    "frame_index": found.call,
                    "camera": camera,
                    "target": groundings[0].object if groundings else "",
                    "margin": held[0] if held else np.nan,
                    "track_score": attended.tracks[camera][0].score,
                    "covers": "",
                    **dict.fromkeys(("cover_iou", "gap_cm", "lift_cm"), np.nan),
                    **{f"{part}_ms": 1e3 * took for part, took in found.seconds.items()},
                }
            )
        if self._folder is None or self._failed:
            return
        if episode.recorder is None:
            episode.recorder = self._open(self._folder, found)
        episode.recorder.add(found.call, at_s, found.views, attended)
        state = {"/observation.state": found.state} if found.state.size else {}
        episode.recorder.add_numbers(found.call, at_s, state, events_of(found))

    def _open(self, folder: Path, found: Prompted) -> DatasetRecorder:
        key = self._key(found)
        names = ("suite", "task", "episode", "seed", "method")
        path = folder / "recordings" / recording_file_name(*(key[name] for name in names))
        path.unlink(missing_ok=True)  # of a server that was killed before its rows were written
        attended = found.attended
        recorder = DatasetRecorder(path, list(found.views), key["task"], 5.0, served=True)
        grounded = [of[0].object for of in attended.groundings.values() if of]
        if grounded:
            obj = self._bank[grounded[0]]
            recorder.ground(found.views, attended, obj, found.instruction)
        return recorder

    def _end(self, stream: object) -> None:
        episode = self._under_way.pop(stream, None)
        if episode is None:
            return
        added = np.array(episode.added_ms)
        later = f", later p50 {np.median(added[1:]):.0f}" if len(added) > 1 else ""
        _say(
            f"episode {episode.first.episode} ends after {len(added)} calls; the proxy added "
            f"{added[0]:.0f} ms to the first{later}"
        )
        if self._folder is None or self._failed:
            return
        try:
            if episode.recorder is not None:
                episode.recorder.__exit__(None, None, None)
            store.write_part(self._folder, FOLDER, episode.steps, caller="serve")
            store.append(self._folder, [self._row(episode)])
        except Exception as error:
            self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        if not self._failed:
            _say(f"note: nothing more is recorded: {first_line(error) or type(error).__name__}")
        self._failed = True

    def _key(self, found: Prompted) -> dict[str, Any]:
        task = re.sub(r"[^a-z0-9]+", "-", found.instruction.lower()).strip("-")[:40] or "no-command"
        number = self._before + found.episode
        return dict(zip(store.KEY, (SUITE, task, self._method, 0, number), strict=True))

    def _row(self, episode: Episode) -> dict[str, Any]:
        """The episode's row: what the prompt says of itself; how it ended is not known."""
        first = episode.first
        held = [row["margin"] for row in episode.steps if row["frame_index"] == 0]
        seen = [of for of in first.attended.groundings.values() if of and of[0].winner is not None]
        return {
            **self._key(first),
            "attempt": 1,
            "policy": self._upstream,
            "outcome": UNKNOWN,
            "case": "",
            "sub_case": "",
            "instruction": first.instruction,
            "rewritten": first.attended.text,
            "views": len(first.views),
            "views_found": len(seen),
            "margin": float(np.nanmin(held)) if np.isfinite(held).any() else np.nan,
            "steps": len(episode.added_ms),
            "starts": first.starts,
            "first_call_ms": episode.added_ms[0],
            "later_calls_ms": float(np.median(episode.added_ms[1:] or [np.nan])),
            "upstream_ms": float(np.median(episode.waited_ms or [np.nan])),
        }


def _say(line: str) -> None:
    tqdm.write(line, file=sys.stderr)
