"""Episodes of VAP and of generic in this process, written to a file: `python -m tests.one_rollout`.

python -m tests.one_rollout OUT.npz --batch 2 --threads 1 --episodes 2
"""

import argparse
import os
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

SUITE, TASK = "simpler-bridge", "put-camera"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--batch", type=int, default=2)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--methods", nargs="+", default=["vap"])
    asked = parser.parse_args()
    os.environ["OMP_NUM_THREADS"] = str(asked.threads)

    import torch

    from vap_core.rollout.loop import rollout
    from vap_core.study.trials import Study, make_trial, register_personal

    torch.set_num_threads(asked.threads)
    study = Study(((SUITE, TASK),), tuple(asked.methods), policy="mini-pi0", follow="step")
    rows = study.rows(SUITE, TASK)[: asked.episodes]
    found: dict[str, np.ndarray] = {}
    with TemporaryDirectory() as folder:
        bank = Path(folder) / "memory"
        register_personal(study, bank)
        for method in asked.methods:
            trial = make_trial(study, rows, method, bank)
            for row, episode in zip(rows, rollout(trial, rows, batch=asked.batch), strict=True):
                key = f"{method}-{row.episode}"
                outcome = episode.outcome
                found[f"{key}-outcome"] = np.array([outcome.success, outcome.steps])
                actions = [frame.action for frame in episode.frames if frame.action is not None]
                found[f"{key}-action"] = np.stack([a for a in actions if a.size])
    np.savez(asked.out, **found)
    return 0


if __name__ == "__main__":
    sys.exit(main())
