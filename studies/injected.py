"""Known faults, put into real measurements: does `close-loop` find them there? `injected`.

The physics, the map that nobody has and the receivers' own faults are those of the real campaigns;
one fault more is made here. So a row tells what no traced city does: whether a cause of known size
is named on real data, how well it is measured, and what else is named than without it. The folder
`RADIOTWIN_DATA` is that of `real`; a minute or two a row.
"""

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from radiotwin import Measurements, close_loop, make_report
from studies.closeloop import causes_of
from studies.closeloop_real import one_in_each_cell, real_campaign
from studies.runner import Study
from studies.tables import markdown, number

EVERY = 8  # a transmitter of `powder_frs` is kept
CELL_M = 10.0  # of `duke_cbrs` one reading of each sector by each phone is kept
STEP_S = 1.6573e9  # between 6 and 11 July 2022
RAIN_S = (1657535000.0, 1657541000.0)  # of 11 July 2022
FLOOR_DBM = {"powder_frs": -84.0, "duke_cbrs": -112.0}
Put = Callable[[pd.DataFrame, pd.DataFrame, np.random.Generator],
               tuple[pd.DataFrame, pd.DataFrame]]


@dataclass(frozen=True)
class Fault:
    """What is put into a campaign.

    Attributes:
        campaign: folder of the real measurements.
        what: in words.
        names: of the effects that would be right.
        parameter: beginning and member of the one that has a size, and that size.
        relative: whether the real campaign has a value of its own, which the fault adds to.
        put: table, devices, generator -> both with the fault.
    """

    campaign: str
    what: str
    names: tuple[str, ...]
    put: Put
    parameter: tuple[str, float] | None = None
    relative: bool = False


def _levels(change: Callable[[pd.DataFrame, np.ndarray, np.random.Generator], np.ndarray]) -> Put:
    """Return a fault of levels alone, from (table, levels, generator) -> levels."""
    def put(table: pd.DataFrame, devices: pd.DataFrame,
            rng: np.random.Generator) -> tuple[pd.DataFrame, pd.DataFrame]:
        level_dbm = table["rssi_dbm"].to_numpy(dtype=float)
        return table.assign(rssi_dbm=np.round(change(table, level_dbm, rng), 2)), devices

    return put


def _of(table: pd.DataFrame, **chosen: str) -> np.ndarray:
    """Return (n,) bool, the rows with these values."""
    return np.all([table[column] == value for column, value in chosen.items()], axis=0)


def _added(level_dbm: np.ndarray, other_dbm: float) -> np.ndarray:
    """Return levels with another power on top [dBm]."""
    return 10 * np.log10(10 ** (level_dbm / 10) + 10 ** (other_dbm / 10))


def _moved(table: pd.DataFrame, devices: pd.DataFrame,
           rng: np.random.Generator) -> tuple[pd.DataFrame, pd.DataFrame]:
    east_m = np.where(devices["device"].isin(["E", "F"]), 80.0, 0.0)
    return table, devices.assign(x_m=devices["x_m"] + east_m)


def _by_position(table: pd.DataFrame, level_dbm: np.ndarray,
                 rng: np.random.Generator) -> np.ndarray:
    own_db = pd.Series(rng.normal(0, 6, table["device"].nunique()), table["device"].unique())
    return level_dbm + table["device"].map(own_db).to_numpy()


def _near(table: pd.DataFrame, level_dbm: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    where_m = table[["receiver_x_m", "receiver_y_m"]].to_numpy()
    away_m = np.linalg.norm(where_m - np.median(where_m, axis=0), axis=1)
    return np.where((away_m < 150) & (rng.random(len(table)) < 0.5), _added(level_dbm, -88.0),
                    level_dbm)


FAULTS = {
    "powder-nothing": Fault("powder_frs", "nothing", (), _levels(lambda t, y, _: y)),
    "powder-gain": Fault(
        "powder_frs", "a receiver reads 8 dB more", ("receiver_gain_offset",), _levels(
            lambda t, y, _: y + 8.0 * _of(t, receiver="moran-nuc2-b210")),
        ("offset_db[moran-nuc2-b210]", 8.0), relative=True),
    "powder-step": Fault(
        "powder_frs", "a receiver reads 10 dB less from a day on", ("receiver_drift",), _levels(
            lambda t, y, _: y - 10.0 * (_of(t, receiver="cbrssdr1-fm-comp")
                                        & (t["time_s"] > STEP_S))),
        ("step_db[cbrssdr1-fm-comp]", -10.0)),
    "powder-flight": Fault(
        "powder_frs", "a receiver reads 15 dB more on one day", ("faulty_flight",), _levels(
            lambda t, y, _: y + 15.0 * _of(t, receiver="cbrssdr1-honors-comp",
                                           flight="2022-07-06")),
        ("offset_db[cbrssdr1-honors-comp, flight 2022-07-06]", 15.0)),
    "powder-episode": Fault(
        "powder_frs", "all lose 10 dB for 100 minutes", ("episode",), _levels(
            lambda t, y, _: y - 10.0 * t["time_s"].between(*RAIN_S).to_numpy()),
        ("loss_db[all]", 10.0)),
    "powder-lock": Fault(
        "powder_frs", "a receiver reads 25 dB less in 3 readings of 10", ("lock_loss",), _levels(
            lambda t, y, rng: y - 25.0 * (_of(t, receiver="cbrssdr1-bes-comp")
                                          & (rng.random(len(t)) < 0.3))),
        ("drop_db[cbrssdr1-bes-comp]", 25.0)),
    "powder-floor": Fault(
        "powder_frs", "a receiver's noise floor is 10 dB higher", ("noise_floor_censoring",),
        _levels(lambda t, y, _: np.where(_of(t, receiver="guesthouse-nuc2-b210"),
                                         _added(y, FLOOR_DBM["powder_frs"]), y)),
        ("floor[guesthouse-nuc2-b210]", FLOOR_DBM["powder_frs"])),
    "powder-saturation": Fault(
        "powder_frs", "a receiver reads no more than -78 dBm", ("receiver_saturation",), _levels(
            lambda t, y, _: np.where(_of(t, receiver="cbrssdr1-hospital-comp"),
                                     np.minimum(y, -78.0), y)),
        ("saturation_level[cbrssdr1-hospital-comp]", -78.0)),
    "powder-transmitters": Fault(
        "powder_frs", "each transmitter differs by 6 dB (not in the catalogue)", (),
        _levels(_by_position)),
    "duke-nothing": Fault("duke_cbrs", "nothing", (), _levels(lambda t, y, _: y)),
    "duke-gain": Fault(
        "duke_cbrs", "a phone reads 8 dB more", ("receiver_gain_offset",), _levels(
            lambda t, y, _: y + 8.0 * _of(t, receiver=t["receiver"].min()))),
    "duke-sector": Fault(
        "duke_cbrs", "a sector radiates 10 dB less", ("device_gain_offset", "antenna_pattern"),
        _levels(lambda t, y, _: y - 10.0 * _of(t, device="C"))),
    "duke-moved": Fault(
        "duke_cbrs", "a mast is declared 80 m further east", ("device_position_error",), _moved),
    "duke-floor": Fault(
        "duke_cbrs", "both phones' noise floor is higher", ("noise_floor_censoring",), _levels(
            lambda t, y, _: _added(y, FLOOR_DBM["duke_cbrs"]))),
    "duke-jammer": Fault(
        "duke_cbrs", "a jammer half of the time within 150 m (not in the catalogue)", (),
        _levels(_near))}


def injected_cases(seed: int) -> dict[str, dict]:
    """Return all faults."""
    return {name: {"fault": name} for name in FAULTS}


def campaign(name: str, seed: int) -> Measurements:
    """Return a real campaign, thinned.

    Raises:
        BadInput: it is not there.
    """
    measured = real_campaign(name)
    table = measured.table
    if name == "powder_frs":
        kept = table["device"].isin(sorted(table["device"].unique())[::EVERY])
        table = table[kept].reset_index(drop=True)
    else:
        table = one_in_each_cell(table, CELL_M, ("device", "receiver"), seed)
    devices = measured.devices[measured.devices["device"].isin(table["device"])]
    return Measurements(table, devices.reset_index(drop=True))


def find_injected(seed: int, settings: dict) -> dict[str, Any]:
    """Close the loop on a campaign with a fault in it."""
    fault = FAULTS[settings["fault"]]
    measured = campaign(fault.campaign, seed)
    table, devices = fault.put(measured.table, measured.devices, np.random.default_rng(seed))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        report = make_report(close_loop(replace(measured, table=table, devices=devices), None,
                                        "log-distance", seed))
    error = report["error"]
    return {"links": len(table), "verdict": report["verdict"],
            "named": [each["name"] for each in causes_of(report)],
            "probabilities": [each.get("probability") for each in report["effects"]],
            "parameters": [each["parameters"] for each in report["effects"]],
            **{f"{when}_db": error[when]["rmse_db"] for when in ("before", "after", "combined")},
            "best_baseline_db": min(each["rmse_db"] for each in report["baselines"].values())}


def injected_table(rows: pd.DataFrame) -> str:
    """Return what is named with each fault that is not named without it, and the sizes found."""
    by_name = rows.set_index("name")
    lines = []
    for name, row in by_name.reindex(list(FAULTS)).dropna(how="all").iterrows():
        fault = FAULTS[str(name)]
        without = by_name.loc[f"{str(name).split('-')[0]}-nothing"]
        lines.append([fault.what, _right(fault, row, without), _new(row, without),
                      _size(fault, row, without), row["verdict"],
                      *(number(row[f"{key}_db"], 2) for key in ("before", "after", "combined",
                                                                "best_baseline"))])
    return markdown(["put into it", "named", "named that is not named without",
                     "size: true, found (90 %)", "verdict", "before [dB]", "after", "combined",
                     "best baseline"], lines,
                    "Faults put into real measurements")


def _right(fault: Fault, row: pd.Series, without: pd.Series) -> str:
    """Return whether the fault is named: of its member, or else where it is not without it."""
    if not fault.names:
        return "–"
    name = fault.parameter[0] if fault.parameter else ""
    found = [number for number, each in enumerate(row["named"]) if each in fault.names and (
        name in row["parameters"][number] if name else each not in without["named"])]
    if not found:
        return "no"
    probability = row["probabilities"][found[0]]
    return "yes" if probability is None else f"yes ({probability:.2f})"


def _new(row: pd.Series, without: pd.Series) -> str:
    new = [name for name in dict.fromkeys(row["named"]) if name not in without["named"]]
    return ", ".join(f"`{name}`" for name in new) or "–"


def _size(fault: Fault, row: pd.Series, without: pd.Series) -> str:
    """Return the true size, and the one that was found, beside the campaign's own if it has one."""
    if fault.parameter is None:
        return "–"
    name, size = fault.parameter
    found, own = _value(row, name), _value(without, name) if fault.relative else None
    true = size + (own["value"] if own else 0.0)
    if found is None:
        return f"{true:.1f}, –"
    return f"{true:.1f}, {found['value']:.1f} ({found['low']:.1f} to {found['high']:.1f})"


def _value(row: pd.Series, name: str) -> dict | None:
    return next((each[name] for each in row["parameters"] if name in each), None)


STUDIES = {"injected": Study("Are known faults found in real measurements?", find_injected,
                             injected_cases, injected_table, seeds=1)}
