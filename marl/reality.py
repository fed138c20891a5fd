"""The two worlds of Algorithm 1: the truth, where flights are real and are measured, and the twin learnt from them."""

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from marl.environment import Environment
from marl.flights import Flights, Policy, fly
from marl.mission import Known, Mission, make_mission
from marl.randomness import stream
from marl.shadowing import twin_shadowing
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.survey.campaign import declared_devices, heading_deg, link_table
from radiotwin.twin import Twin, fit_twin

TWINS = {"nn": "segmented_nn", "log-distance": "log_distance", "kriging": "regression_kriging",
         "raytrace": "raytrace"}
"""Name of a twin on the command line -> model of `fit_twin`."""


@dataclass
class Reality:
    """Real flights, and what was measured on them.

    Args:
        scene: its devices are told as far as they are anchors.
        truth: radio map that decides what UAVs receive.
        assignment: see `make_mission`.
        noise_db: standard deviation of the receivers' measurement error [dB].
        seed: of shadowing and noise.
    """

    scene: Scene
    truth: RadioMap
    assignment: str
    noise_db: float
    seed: int
    tables: list[pd.DataFrame] = field(default_factory=list)

    def mission(self, known: Known) -> Mission:
        """The mission in the truth, for UAVs that know these positions."""
        return make_mission(self.scene, self.truth, known, self.assignment)

    def twin_mission(self, twin: Twin, known: Known, measurements: Measurements | None = None) -> Mission:
        """The mission in the twin; what its map is wrong about lasts as long as `measurements` say, where they are
        given, otherwise for a slot."""
        radio_map = twin.radio_map(self.scene)
        mission = make_mission(self.scene, radio_map, known, self.assignment)
        if measurements is None:
            return mission
        share, length_m = twin_shadowing(twin, radio_map, measurements, self.scene.config.gain_limit_db, self.seed)
        return mission._replace(shadowing_share=share, shadowing_m=length_m)

    def fly(self, policy: Policy, known: Known) -> Flights:
        """Fly one real episode with all UAVs, measure every device in every slot, and keep the measurements."""
        mission = self.mission(known)
        number = len(self.tables)
        rng = stream(self.seed, "real flight", number)
        flights = fly(Environment(mission, 1, rng), policy)
        self.tables.append(self._measured(flights, f"f{number}", rng))
        return flights

    def measurements(self) -> Measurements:
        """All that was measured so far."""
        return Measurements(pd.concat(self.tables, ignore_index=True), declared_devices(self.scene))

    def _measured(self, flights: Flights, name: str, rng: np.random.Generator) -> pd.DataFrame:
        config, lattice = self.scene.config, self.scene.lattice
        slots, frames = int(flights.length[0]), flights.frames
        time_s = config.mission.slot_s * (np.arange(slots) + len(self.tables) * flights.action.shape[1])
        tables = []
        for u, uav in enumerate(config.uavs):
            flown = slice(0, max(int((frames.battery[0, :slots, u] > 0).sum()), 1))
            cells = frames.cell[0, flown, u].astype(int)
            level = int(np.abs(lattice.z_m - uav.altitude_m).argmin())
            index = np.ravel_multi_index((np.full(len(cells), level), cells[:, 0], cells[:, 1]), lattice.shape)
            level_db = frames.snr_db[0, flown, u].T.astype(float) - config.radio.tx_power_dbm + config.radio.noise_dbm
            level_db = level_db + rng.normal(0, self.noise_db, level_db.shape)
            level_db[level_db < config.gain_limit_db] = np.nan
            tables.append(link_table(self.scene, name, uav.uav, index, level_db, time_s[flown], heading_deg(cells)))
        return pd.concat(tables, ignore_index=True)


def learn_twin(reality: Reality, kind: str, seed: int, before: Twin | None) -> Twin:
    """Learn the channel and the positions from all measurements.

    Raises:
        BadInput: no such kind of twin.
    """
    if kind not in TWINS:
        raise BadInput(f"twin {kind!r} is unknown; allowed are {', '.join(TWINS)}")
    return fit_twin(reality.measurements(), reality.scene, model=TWINS[kind], seed=seed, start=before)


def known_by(twin: Twin) -> Known:
    """The positions that a twin knows, or estimates."""
    return Known({d.device: (d.x_m, d.y_m) for d in twin.devices if np.isfinite([d.x_m, d.y_m]).all()})


def location_errors_m(scene: Scene, known: Known) -> np.ndarray:
    """Distance of each unknown device's estimate from its true position [m]; NaN where there is none."""
    return np.array([np.hypot(*np.subtract(known.position_m.get(d.device, (np.nan, np.nan)), (d.x_m, d.y_m)))
                     for d in scene.config.devices if d.role == "unknown"])
