"""Repeat a run with several seeds; report interquartile means with bootstrap bands over seeds.

After Agarwal et al., "Deep reinforcement learning at the edge of the statistical precipice",
NeurIPS 2021.
"""

from pathlib import Path

import numpy as np
import pandas as pd
from scipy.stats import trim_mean

from marl.algorithm1 import FLIGHTS
from marl.figures import draw_curve
from marl.session import FLIGHTS_SAY, Session, flights_text, regret_text, require_free
from marl.settings import LearnerSettings, RunSettings
from radiotwin.io.cells import write_csv
from radiotwin.io.files import atomic_path
from radiotwin.runtime.console import print_rows

CONFIDENCE, DRAWS = 0.95, 10_000  # of the bootstrap bands


def run_seeds(run: RunSettings, learner: LearnerSettings, out: Path, resume: bool,
              seeds: int) -> None:
    """Run with seeds `run.seed`, `run.seed` + 1, … in subfolders of `out`, and write a summary.

    Raises:
        BadInput: as `Session.execute`.
    """
    if not resume:
        require_free(out, "--resume goes on with the runs in it, --out names another folder")
    tables, curves = [], dict[str, list[list[dict]]]()
    for seed in range(run.seed, run.seed + seeds):
        folder = out / f"seed-{seed}"
        session = Session(run.model_copy(update={"seed": seed}), learner, folder,
                          resume and (folder / "config.json").exists())
        table, rows = session.execute()
        tables.append(table[~table["trained_in"].str.contains("recorded")])
        for name, each in rows.items():
            curves.setdefault(name, []).append(each)
    summary = [dict(zip(("method", "trained_in"), key)) | {
        "seeds": len(group), **group[["real_episodes", *FLIGHTS]].iloc[0],
        "regret": group["regret"].mean()} | over_seeds(group["truth_ratio"].to_numpy())
        for key, group in pd.concat(tables).groupby(["method", "trained_in"], sort=False)]
    with atomic_path(out / "seeds.csv") as temporary:
        write_csv(pd.DataFrame(summary), temporary)
    draw_curve({name: [{"real_episodes": rows[0]["real_episodes"]}
                       | over_seeds(np.array([row["truth_ratio"] for row in rows]))
                       for rows in zip(*each)] for name, each in curves.items()},
               {}, out / "curve.png")
    print_rows(f"Collected in the truth ({run.truth}), of all data; interquartile mean of {seeds} "
               f"seeds, and its {CONFIDENCE:.0%} band. {FLIGHTS_SAY}",
               {"method": "left", "trained in": "left", "real flights": "right",
                "regret": "right", "collected": "right", "from": "right", "to": "right"},
               [[row["method"], row["trained_in"], flights_text(row), regret_text(row),
                 *(f"{row[name]:.3f}" for name in ("truth_ratio", "low", "high"))]
                for row in summary])


def over_seeds(ratio: np.ndarray) -> dict[str, float]:
    """Return interquartile mean of shares (S,) of S seeds, and bootstrap band; NaN of a single."""
    if len(ratio) == 1:
        return {"truth_ratio": float(ratio[0]), "low": np.nan, "high": np.nan}
    draws = np.random.default_rng(0).choice(ratio, (DRAWS, len(ratio)))
    low, high = np.quantile(trim_mean(draws, 0.25, axis=1), [(1 - CONFIDENCE) / 2,
                                                            (1 + CONFIDENCE) / 2])
    return {"truth_ratio": float(trim_mean(ratio, 0.25)), "low": float(low), "high": float(high)}
