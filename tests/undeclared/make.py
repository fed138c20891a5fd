"""Trace all tables that are not there yet.

    python -m tests.undeclared.make [--only NAME ...] [--again]

Needs libLLVM and two to three hours on two cores. Each table is written as soon as it is traced: run it again
after an interruption and it continues. NAME is a family or a group of worlds; worlds come before the cases in them.
The scene folders are written first; they come out the same every time.
"""

import argparse
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.undeclared import cities, hidden, tables
from tests.undeclared.families import GROUP, SEEDS, is_traced, traced_effects
from tests.undeclared.truth import Antenna, TrueCity
from tests.undeclared.worlds import GROUPS, UAVS, World, world


def trace_world(where: World) -> np.ndarray:
    """(k, p) gain of a world with nothing hidden [dB]."""
    with TemporaryDirectory() as folder:
        city = _city(folder, where, [])
        return np.stack([city.gains(device_m, where.points_m) for device_m in where.device_m])


def trace_case(where: World, effects: list[dict], gain_db: np.ndarray) -> np.ndarray:
    """(k, p) gain with effects hidden [dB]; only the links are traced that they can change."""
    device_m, antennas = where.device_m.copy(), {}
    changed = np.zeros(gain_db.shape, dtype=bool)
    receiver_antenna, points = Antenna(), np.arange(len(where.points_m))
    for effect in effects:
        if effect["name"] in ("missing_obstacle", "removed_obstacle"):
            changed[:] = True
        elif effect["name"] == "device_position_error":
            row = where.names.index(effect["device"])
            device_m[row], changed[row] = effect["true_m"], True
        elif effect["kind"] == "sector":
            row = where.names.index(effect["device"])
            turn = np.radians([90 - effect["azimuth_deg"], effect["downtilt_deg"], 0.0])
            antennas[row], changed[row] = Antenna(effect["pattern"], turn), True
        else:
            points = np.flatnonzero(where.receiver == [f"uav{n}" for n in range(UAVS)].index(effect["receiver"]))
            turns = hidden.dipole_turns_rad(where, points, effect["tilt_deg"], effect["tilt_towards_deg"])
            receiver_antenna, changed[:, points] = Antenna(effect["pattern"], turns), True
    gain_db = gain_db.copy()
    with TemporaryDirectory() as folder:
        city = _city(folder, where, effects)
        for row in np.flatnonzero(changed.any(axis=1)):
            gain_db[row, points] = city.gains(device_m[row], where.points_m[points],
                                              antennas.get(row, Antenna()), receiver_antenna)
    return gain_db


def _city(folder: str, where: World, effects: list[dict]) -> TrueCity:
    names = [effect["name"] for effect in effects]
    gone = next((effect["building"] for effect in effects if effect["name"] == "removed_obstacle"), None)
    towers = where.towers if "missing_obstacle" in names else ()
    number = 10 * GROUPS.index(where.group) + where.seed  # a survey of its own for every world
    xml_path = cities.write_truth(Path(folder), where.city, number, without=gone, more=towers)
    return TrueCity(xml_path, cities.RADIO[where.city].frequency_hz)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", nargs="*", default=[*GROUPS, *GROUP], help="families and groups of worlds")
    parser.add_argument("--again", action="store_true", help="trace tables that are there anew")
    given = parser.parse_args()
    only = given.only
    if not cities.SCENES.is_file():
        cities.write_declared()
    jobs = []
    for seed in SEEDS:
        jobs += [(group, seed, None) for group in GROUPS]
        jobs += [(GROUP[family], seed, family) for family in GROUP if is_traced(family, seed)]
    jobs = [job for job in jobs if (job[2] or job[0]) in only]
    for number, (group, seed, family) in enumerate(jobs, start=1):
        make_table(group, seed, family, given.again)
        print(f"{number}/{len(jobs)} tables are there", flush=True)


def make_table(group: str, seed: int, family: str | None, again: bool = False) -> None:
    """Trace a world, or a case in it, and store the table, unless it is there; a case's world comes first."""
    where = world(group, seed)
    key = tables.case_key(family, seed) if family else tables.world_key(where.group, where.seed)
    if key in tables.keys() and not again:
        return
    if family is not None:
        make_table(group, seed, None)
    started = time.monotonic()
    if family is None:
        effects, gain_db = [], trace_world(where)
    else:
        effects = traced_effects(family, seed)
        gain_db = trace_case(where, effects, tables.load(tables.world_key(where.group, where.seed), where)[0])
    tables.save(key, where, gain_db, effects)
    print(f"{key}: {time.monotonic() - started:.0f} s", flush=True)


if __name__ == "__main__":
    main()
