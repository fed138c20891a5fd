"""Test the reported least sizes: are effects of that size named when added? `sizes`.

Campaigns in which nothing is hidden, over open ground and in cities whose maps are wrong: the loop
says from which sizes on it would have named what it did not. Effects of that size and of one and a
half times it are then put into the levels, by formulas of this module, and the loop is closed
again. `python -m studies sizes --resume`: hours on one core.
"""

import warnings
from collections.abc import Callable

import numpy as np
import pandas as pd

from radiotwin import Loop, Measurements, close_loop
from radiotwin.scene import Scene
from studies.runner import Study
from studies.tables import markdown, number
from tests.undeclared.foreign.cases import foreign_case
from tests.undeclared.open_ground import CASES, open_case

TIMES = (1.0, 1.5)  # the size that was told
CITIES = ("city02-w1-c3", "city13-w1-c1", "city15-w0-c3")  # for calibration; nothing is hidden
MIN_ROWS = 40  # of a device, a receiver or a flight, and behind a building
BEAMWIDTH_DEG, EPISODE = 65.0, 0.1
WIDE_M, HIGH_M = 20.0, 15.0  # of a building
TRIES = 200
Change = Callable[[Measurements, float, np.random.Generator], Measurements | None]


def sizes_cases(seed: int) -> dict[str, dict]:
    """Return the campaigns over open ground, then those in cities; seed 0 only."""
    names = [f"open:{number}" for number in range(0, CASES, 5)]
    return {} if seed else {name: {"case": name} for name in (*names, *CITIES)}


def put_in_again(seed: int, settings: dict) -> dict:
    """Close the loop on a campaign, then again with effects of the reported least sizes added."""
    kind, _, number = settings["case"].partition(":")
    case = open_case(int(number)) if number else foreign_case(kind)
    loop = _close(case.measurements, case.scene, seed)
    told = {each.name: each.size for each in loop.detectable}
    found: list[list] = []
    for family, size in told.items():
        if family not in HIDE or not np.isfinite(size) or (family in BY_SIGHT and case.scene):
            continue
        for times in TIMES:
            rng = np.random.default_rng([seed, len(found)])
            changed = HIDE[family](case.measurements, times * size, rng)
            if changed is not None:
                again = _close(changed, case.scene, seed)
                found.append([family, round(size, 2), times, _named(again)])
    return {"named": _named(loop), "told": {name: round(size, 2) for name, size in told.items()
                                     if np.isfinite(size)}, "again": found}


def _close(measured: Measurements, scene: Scene | None, seed: int) -> Loop:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return close_loop(measured, scene, seed=seed)


def _named(loop: Loop) -> list[str]:
    return [each.name for each in loop.after.whole.effects
            if each.is_cause and not each.is_declared]


def _louder(measured: Measurements, change_db: np.ndarray) -> Measurements:
    table = measured.table.assign(gain_db=measured.table["gain_db"] + change_db)
    return Measurements(table, measured.devices)


def _one(measured: Measurements, columns: list[str],
         rng: np.random.Generator) -> np.ndarray | None:
    """Return the mask of one member with levels enough, drawn at random; None where none is."""
    label = measured.table.groupby(columns).ngroup().to_numpy()
    seen = measured.table["gain_db"].notna().to_numpy()
    values, counts = np.unique(label[seen], return_counts=True)
    values = values[counts >= MIN_ROWS]
    return label == rng.choice(values) if len(values) > 1 else None


def _offset(column: str) -> Change:
    def change(measured: Measurements, size_db: float,
               rng: np.random.Generator) -> Measurements | None:
        mine = _one(measured, [column], rng)
        return None if mine is None else _louder(measured, size_db * mine)
    return change


def _drift(column: str) -> Change:
    def change(measured: Measurements, size_db: float,
               rng: np.random.Generator) -> Measurements | None:
        mine = _one(measured, [column], rng)
        if mine is None:
            return None
        time_s = measured.table["time_s"].to_numpy()
        first_s, last_s = time_s[mine].min(), time_s[mine].max()
        return _louder(measured, np.where(mine, size_db * (time_s - first_s)
                                          / max(last_s - first_s, 1.0), 0.0))
    return change


def _episode(measured: Measurements, size_db: float,
             rng: np.random.Generator) -> Measurements | None:
    mine = _one(measured, ["receiver"], rng)
    if mine is None:
        return None
    time_s = measured.table["time_s"].to_numpy()
    start = rng.uniform(0.3, 0.6)
    first_s, last_s = np.quantile(time_s[mine], [start, start + EPISODE])
    return _louder(measured, -size_db * (mine & (time_s >= first_s) & (time_s <= last_s)))


def _faulty_flight(measured: Measurements, size_db: float,
                   rng: np.random.Generator) -> Measurements | None:
    """Weaken one flight of one receiver, which flew before it and after it."""
    table = measured.table
    start_s = table.groupby(["receiver", "flight"])["time_s"].min()
    between = [(receiver, flight) for receiver, flight in start_s.index
               if start_s[receiver].min() < start_s[receiver, flight] < start_s[receiver].max()]
    if not between:
        return None
    receiver, flight = between[rng.integers(len(between))]
    mine = (table["receiver"] == receiver) & (table["flight"] == flight)
    return _louder(measured, -size_db * mine.to_numpy())


def _sector(measured: Measurements, size_db: float,
            rng: np.random.Generator) -> Measurements | None:
    mine = _one(measured, ["device"], rng)
    if mine is None:
        return None
    away_m = _receivers_m(measured) - _devices_m(measured)
    azimuth_deg = np.degrees(np.arctan2(away_m[:, 0], away_m[:, 1]))
    middle = np.angle(np.exp(1j * np.radians(azimuth_deg[mine])).mean(), deg=True)
    off_deg = (azimuth_deg - middle + 180) % 360 - 180
    return _louder(measured, -size_db * mine * np.minimum(0.5 * (off_deg / BEAMWIDTH_DEG)**2, 1.0))


def _moved(measured: Measurements, size_m: float,
           rng: np.random.Generator) -> Measurements | None:
    devices = measured.devices.copy()
    anchors = devices.index[(devices["role"] == "anchor") & devices["device"].isin(
        measured.table.loc[measured.table["gain_db"].notna(), "device"])]
    if not len(anchors):
        return None
    devices.loc[rng.choice(anchors), "y_m"] += size_m
    return Measurements(measured.table, devices)


def _hidden(measured: Measurements, size_db: float,
            rng: np.random.Generator) -> Measurements | None:
    """Weaken the links that pass a building which a straight line between two ends crosses."""
    a_m, b_m = _devices_m(measured), _receivers_m(measured)
    for _ in range(TRIES):
        link, share = rng.integers(len(a_m)), rng.choice([0.1, 0.3, 0.5, 0.7, 0.9])
        centre_m = a_m[link, :2] + share * (b_m[link] - a_m[link])[:2]
        low_m, high_m = np.r_[centre_m - WIDE_M / 2, -10.0], np.r_[centre_m + WIDE_M / 2, HIGH_M]
        with np.errstate(divide="ignore", invalid="ignore"):
            shares = np.sort([(low_m - a_m) / (b_m - a_m), (high_m - a_m) / (b_m - a_m)], axis=0)
        enter, leave = np.maximum(shares[0].max(axis=1), 0), np.minimum(shares[1].min(axis=1), 1)
        behind = enter < leave
        if behind.sum() >= MIN_ROWS:
            return _louder(measured, -size_db * behind)
    return None


def _receivers_m(measured: Measurements) -> np.ndarray:
    return measured.table[[f"receiver_{axis}_m" for axis in "xyz"]].to_numpy(float)


def _devices_m(measured: Measurements) -> np.ndarray:
    place = measured.devices.set_index("device")[["x_m", "y_m", "z_m"]]
    return place.loc[measured.table["device"]].to_numpy(float)


HIDE: dict[str, Change] = {
    "receiver_gain_offset": _offset("receiver"), "device_gain_offset": _offset("device"),
    "receiver_drift": _drift("receiver"), "device_drift": _drift("device"), "episode": _episode,
    "faulty_flight": _faulty_flight, "antenna_pattern": _sector,
    "device_position_error": _moved, "missing_obstacle": _hidden}
BY_SIGHT = frozenset({"missing_obstacle"})  # over a city it would stand among buildings


def sizes_table(rows: pd.DataFrame) -> str:
    """Return the table of how often effects of the reported sizes are named, by family."""
    again = pd.DataFrame([[row["name"], family, size, times, family in named,
                           any(name != family for name in named if name not in row["named"])]
                          for row in rows.to_dict("records")
                          for family, size, times, named in row["again"]],
                         columns=["case", "family", "size", "times", "named", "other"])
    parts = []
    for where, mine in again.groupby(again["case"].str.startswith("open:"), sort=False):
        lines = [_line(f"`{family}`", each) for family, each in mine.groupby("family")]
        parts.append(markdown(
            ["hidden", "size told, median", *(f"named at {times:g} times it" for times in TIMES),
             "another name given"], [*lines, _line("all", mine)],
            "Over open ground" if where else "In cities whose maps are wrong",
            f" ({mine['case'].nunique()} campaigns)"))
    return "\n\n".join(parts)


def _line(label: str, mine: pd.DataFrame) -> list[str]:
    shares = [mine.loc[mine["times"] == times, "named"] for times in TIMES]
    return [label, number(mine["size"].median()) if label != "all" else "",
            *(f"{each.sum()} of {len(each)}" for each in shares), str(mine["other"].sum())]


STUDIES = {"sizes": Study("Is what would have been named, named?", put_in_again, sizes_cases,
                          sizes_table, seeds=1)}
