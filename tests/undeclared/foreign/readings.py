"""What receivers make of levels, and what a campaign's table keeps: noise, steps, limits, blanks, gaps and clocks."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from tests.undeclared.foreign.scenario import Scenario

SILENT_DB = -250.0  # a declared limit that says nothing


@dataclass(frozen=True)
class Habits:
    """How a campaign was measured, beside all that is hidden.

    Attributes:
        noise_db: standard deviation of a reading.
        tails: degrees of freedom of Student's t; None: Gaussian.
        step_db: of the readings.
        limit_db: true limit of each receiver, as a gain.
        declared: `right`, `wrong`, `silent`; the first of them as far as receivers have one limit.
        declared_db: limit that the scene declares, as a gain.
        blanks: whether links that were not detected are in the table.
        gaps: share of points whose rows are missing.
        clock: `campaign`, `flight` (it restarts) or `none`.
        attitude: whether headings and angles are in the table.
        sent_dbm: added to gains, which are then `rssi_dbm`; None: `gain_db`.
        place_m: standard deviation of written positions, horizontally.
        unknown: number of devices of unknown position.
    """

    noise_db: float
    tails: float | None
    step_db: float
    limit_db: tuple[float, ...]
    declared: str
    declared_db: float
    blanks: bool
    gaps: float
    clock: str
    attitude: bool
    sent_dbm: float | None
    place_m: float
    unknown: int


def draw_habits(at: Scenario, needs_time: bool, needs_attitude: bool, rng: np.random.Generator) -> Habits:
    """Draw how a campaign was measured."""
    receivers = at.where.campaign.receiver.max() + 1
    heard_db = at.plain_db[np.isfinite(at.plain_db)]
    common_db = float(np.quantile(heard_db, rng.choice([0.0, rng.uniform(0.01, 0.25)], p=[0.2, 0.8])))
    differ = receivers > 1 and rng.random() < 0.3
    limit_db = common_db + (rng.uniform(-6, 6, receivers) if differ else np.zeros(receivers))
    declared = str(rng.choice(["right", "wrong", "silent"], p=[0.3, 0.25, 0.45]))
    declared_db = {"right": common_db, "wrong": common_db + rng.choice([-10, 10]), "silent": SILENT_DB}[declared]
    clock = str(rng.choice(["campaign", "flight", "none"], p=[0.55, 0.33, 0.12]))
    return Habits(
        noise_db=round(float(rng.uniform(0.5, 2.5)), 2), tails=float(rng.choice([3, 4, 6])) if rng.random() < 0.35 else None,
        step_db=float(rng.choice([0.1, 0.25, 0.5, 1.0])), limit_db=tuple(float(one) for one in limit_db.round(2)),
        declared=declared, declared_db=float(declared_db), blanks=bool(rng.random() < 0.7),
        gaps=float(rng.choice([0.0, rng.uniform(0.02, 0.15)])), clock="campaign" if needs_time else clock,
        attitude=bool(rng.random() < 0.7) or needs_attitude,
        sent_dbm=round(float(rng.uniform(-10, 46)), 1) if rng.random() < 0.25 else None,
        place_m=float(rng.choice([0.0, rng.uniform(0.1, 0.8)])),
        unknown=0 if at.devices <= 3 else int(rng.choice([0, 1, 2], p=[0.76, 0.16, 0.08])))


def read_db(at: Scenario, habits: Habits, arriving_db: np.ndarray, clean_db: np.ndarray, rng: np.random.Generator
            ) -> np.ndarray:
    """(n,) readings as gains, NaN where nothing is detected.

    A receiver detects what arrives above its limit, and reports what it reads above it.
    """
    noise = rng.standard_normal(at.links) if habits.tails is None else (
        rng.standard_t(habits.tails, at.links) / np.sqrt(habits.tails / (habits.tails - 2)))
    noise_db, limit_db = habits.noise_db * noise, np.array(habits.limit_db)[at.of_links("receiver")]
    detected = (arriving_db + noise_db >= limit_db) & (clean_db + noise_db >= limit_db)
    level_db = clean_db + noise_db
    if habits.sent_dbm is None:
        level_db = np.minimum(level_db, 0.0)
    offset_db = habits.sent_dbm or 0.0
    return np.where(detected, np.round((level_db + offset_db) / habits.step_db) * habits.step_db - offset_db, np.nan)


def table_of(at: Scenario, habits: Habits, level_db: np.ndarray, written_m: np.ndarray, rng: np.random.Generator
             ) -> tuple[pd.DataFrame, np.ndarray]:
    """Return the table as the user has it, point by point, and the (m,) link of each of its rows."""
    campaign = at.where.campaign
    off_m = np.clip(rng.normal(0, 1, (at.points, 3)), -2, 2) * habits.place_m
    given_m = np.round(written_m + off_m, 2)
    given_m[:, 2] = np.maximum(given_m[:, 2], 0.3)
    time_s = campaign.time_s.copy()
    if habits.clock == "flight":
        for flight in np.unique(campaign.flight):
            time_s[campaign.flight == flight] -= time_s[campaign.flight == flight].min()
    kept = rng.random(at.points) >= habits.gaps
    order = np.lexsort((at.device, at.point))
    order = order[kept[at.point[order]]]
    if not habits.blanks:
        order = order[np.isfinite(level_db[order])]
    point = at.point[order]
    columns = {"time_s": time_s[point]} if habits.clock != "none" else {}
    columns |= {"flight": np.array([f"f{number + 1}" for number in campaign.flight], dtype=object)[point],
                "receiver": np.array([f"r{number + 1}" for number in campaign.receiver], dtype=object)[point]}
    columns |= {f"receiver_{axis}_m": given_m[point, index] for index, axis in enumerate("xyz")}
    columns["device"] = np.array([f"d{number + 1}" for number in range(at.devices)], dtype=object)[at.device[order]]
    columns["gain_db" if habits.sent_dbm is None else "rssi_dbm"] = np.round(level_db[order] + (habits.sent_dbm or 0.0), 2)
    if habits.attitude:
        columns |= {name: getattr(campaign, name)[point] for name in ("heading_deg", "pitch_deg", "roll_deg")}
    return pd.DataFrame(columns), order
