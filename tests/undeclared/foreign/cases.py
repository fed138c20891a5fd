"""Measurements of foreign worlds with hidden effects, and the answers.

    names("judge")                          # of the cases whose worlds are traced
    foreign_case("city01-w0-c2").answer     # what neither measurements nor scene says
    foreign_case("city01-w0-c2", hidden=False)   # the oracle's: the same campaign with nothing hidden
"""

import atexit
import json
import zlib
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from radiotwin.links.measurements import Measurements
from radiotwin.scene import Scene
from tests.undeclared.foreign.deck import ATTITUDE, CASES, DRAWS, TIMED, dealt
from tests.undeclared.foreign.layouts import SPLITS
from tests.undeclared.foreign.maps import write_map
from tests.undeclared.foreign.readings import Habits, draw_habits, read_db, table_of
from tests.undeclared.foreign.scenario import Hidden, Scenario
from tests.undeclared.foreign.store import stored
from tests.undeclared.foreign.worlds import city_of

LEAST_DB, TRIES = 0.15, 30  # of what is hidden, over the links that can be heard

__all__ = ["ForeignCase", "families", "foreign_case", "names", "split_of"]


@dataclass(frozen=True, eq=False)
class ForeignCase:
    """One campaign; n rows of `measurements.table`.

    Attributes:
        name: `cityNN-wN-cN`
        split: `calibrate` or `judge`; cities belong to one of them.
        measurements: as the user has them; NaN = not detected.
        scene: as declared; it names no device.
        answer: `effects`, a list of what is hidden: `name`, `in_catalogue`, and true parameters with units in their
            names; `device_m`, true positions of devices whose position is unknown or wrongly declared [m]; `nuisance`,
            what is not as declared in any campaign: errors of the map, habits of the receivers.
        clean_level_db: (n,) what ideal receivers without a limit would read, with all that is hidden [dB or dBm, as the
            table]; NaN where there is no path.
        plain_level_db: (n,) the same with nothing hidden.
        size_db: root mean square of what is hidden, over the detected links [dB]: the change of levels, or what the
            wrong map or position changes in free space with the median loss of shadowed links.
        changes_db: of each hidden effect alone, (n,) what it changes [dB], as for `size_db`; NaN where it takes the
            reading away.
    """

    name: str
    split: str
    measurements: Measurements
    scene: Scene
    answer: dict
    clean_level_db: np.ndarray
    plain_level_db: np.ndarray
    size_db: float
    changes_db: tuple[np.ndarray, ...]
    los: np.ndarray


def names(split: str | None = None) -> list[str]:
    """Return the names of the cases whose worlds are traced, in that order, of a split or of both; ValueError: no such."""
    if split not in (None, *SPLITS):
        raise ValueError(f"split {split!r} does not exist; there are {' and '.join(SPLITS)}")
    return [f"{name}-c{number}" for name in stored() for number in range(CASES)
            if split in (None, split_of(name))]


def split_of(name: str) -> str:
    """Return the split of a case."""
    return city_of(name).split


def families(name: str) -> tuple[str, ...]:
    """Return the families that a case hides."""
    return dealt()[name]


def foreign_case(name: str, hidden: bool = True) -> ForeignCase:
    """Draw a case from its world's trace; `hidden` False: the same campaign with nothing hidden in it, for the oracle."""
    at = Scenario.of(name.rpartition("-")[0])
    rng = {purpose: np.random.default_rng([zlib.crc32(f"{name}/{purpose}".encode())])
           for purpose in ("effects", "habits", "noise", "table")}
    habits = draw_habits(at, bool(TIMED & set(families(name))), bool(ATTITUDE & set(families(name))), rng["habits"])
    audible = at.plain_db >= np.array(habits.limit_db)[at.of_links("receiver")]
    drawn = [_seen(family, at, audible, rng["effects"]) for family in families(name)]
    if any(one.lost is not None for one in drawn):  # nobody could miss what is in no table
        habits = replace(habits, blanks=True)
    found = drawn if hidden else []
    arriving_db = at.arriving_db(found)
    clean_db = arriving_db
    for one in found:
        clean_db = one.reads(clean_db) if one.reads is not None else clean_db
    level_db = read_db(at, habits, arriving_db, clean_db, rng["noise"])
    for one in found:
        level_db = np.where(one.lost, np.nan, level_db) if one.lost is not None else level_db
    written_m, device_m = _written(at, found)
    table, link = table_of(at, habits, level_db, written_m, rng["table"])
    offset_db = habits.sent_dbm or 0.0
    clean_db, plain_db = (np.where(np.isfinite(one), one + offset_db, np.nan)[link] for one in (clean_db, at.plain_db))
    return ForeignCase(name, at.where.city.split, Measurements(table, _devices(device_m, habits)),
                       _scene(at, habits, found), _answer(at, habits, found, device_m), clean_db, plain_db,
                       _size_db(at, found, np.isfinite(level_db)),
                       tuple(np.where(one.lost, np.nan, _change_db(at, [one]))[link] if one.lost is not None
                             else _change_db(at, [one])[link] for one in found), at.direct[link])


def _seen(family: str, at: Scenario, audible: np.ndarray, rng: np.random.Generator) -> Hidden:
    """Draw an effect that does something to audible links (n,): a lorry that stands where no path goes is drawn again."""
    for _ in range(TRIES):
        found = DRAWS[family](at, rng)
        if found.lost is not None or _size_db(at, [found], audible) >= LEAST_DB:
            break
    return found


def _devices(device_m: np.ndarray, habits: Habits) -> pd.DataFrame:
    is_anchor = np.arange(len(device_m)) < len(device_m) - habits.unknown
    plane_m = np.where(is_anchor[:, None], device_m[:, :2], np.nan)
    return pd.DataFrame({"device": [f"d{number + 1}" for number in range(len(device_m))], "x_m": plane_m[:, 0],
                         "y_m": plane_m[:, 1], "z_m": device_m[:, 2], "role": np.where(is_anchor, "anchor", "unknown")})


def _scene(at: Scenario, habits: Habits, found: list[Hidden]) -> Scene:
    """Write the declared scene to a folder that goes with the process."""
    folder = TemporaryDirectory(prefix="radiotwin-foreign-")
    atexit.register(folder.cleanup)
    limit_db = habits.declared_db if habits.declared == "silent" else habits.declared_db + (habits.sent_dbm or 0.0)
    write_map(Path(folder.name), at.where, limit_db, [index for one in found for index in one.map_lacks],
              [building for one in found for building in one.map_shows])
    return Scene.load(folder.name)


def _answer(at: Scenario, habits: Habits, found: list[Hidden], device_m: np.ndarray) -> dict:
    where, known = at.where, at.devices - habits.unknown
    elsewhere = [number for number in range(at.devices)
                 if number >= known or not np.array_equal(device_m[number], where.device_m[number])]
    stands = [one is not None for one in where.true]

    def corners(indices: list[int]) -> list:
        return [where.city.buildings[index].footprint_m.tolist() for index in indices]

    every = range(len(stands))
    effects = [{"name": one.name, "in_catalogue": one.in_catalogue} | one.truth for one in found]
    return {"effects": json.loads(json.dumps(effects, default=float)),
            "device_m": {f"d{number + 1}": where.device_m[number].tolist() for number in elsewhere},
            "nuisance": {
                "frequency_hz": where.frequency_hz, "walls_m": where.gaps_m[0], "heights_m": where.gaps_m[1],
                "unmapped": corners([index for index in every if stands[index] and not where.mapped[index]]),
                "gone": corners([index for index in every if not stands[index] and where.mapped[index]]),
                "max_depth": where.settings.max_depth, "scattering": where.settings.scattering,
                "stations": where.campaign.stations, **asdict(habits)}}


def _written(at: Scenario, found: list[Hidden]) -> tuple[np.ndarray, np.ndarray]:
    """Return written positions of the points (p, 3) and declared positions of the devices (k, 3) [m]."""
    written_m = next((one.written_m for one in found if one.written_m is not None), at.where.campaign.points_m)
    return written_m, next((one.device_m for one in found if one.device_m is not None), at.where.device_m[:-1])


def _size_db(at: Scenario, found: list[Hidden], detected: np.ndarray) -> float:
    """See `ForeignCase.size_db`; `detected` (n,) bool."""
    return float(np.sqrt(np.mean(_change_db(at, found)[detected]**2)))


def _change_db(at: Scenario, found: list[Hidden]) -> np.ndarray:
    """Return what effects change (n,) [dB]; what a wrong map or position does is rough."""
    reading_db = at.arriving_db(found)
    for one in found:
        reading_db = one.reads(reading_db) if one.reads is not None else reading_db
    heard = np.isfinite(at.plain_db) & np.isfinite(reading_db)
    change_db = np.subtract(reading_db, at.plain_db, out=np.zeros(at.links), where=heard)
    lacks = [at.where.true[index] for one in found for index in one.map_lacks]
    shows = [building for one in found for building in one.map_shows]
    if lacks or shows or any(one.written_m is not None or one.device_m is not None for one in found):
        written_m, device_m = _written(at, found)
        mapped = [one for one in at.standing if one not in lacks] + shows
        change_db = change_db + (at.rough_db(at.where.device_m[:-1], at.where.campaign.points_m, at.standing)
                                 - at.rough_db(device_m, written_m, mapped))
    return change_db
