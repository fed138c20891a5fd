"""Draw possible worlds from a twin's uncertainty, to start a belief and to evaluate plans.

Uncertain are device positions, device levels, the map, which devices transmit, and their data.
"""

import numpy as np

from marl.belief import Prior
from marl.environment import CorrelatedField
from marl.mission import Mission, levels_of, snr_offset_db
from radiotwin.maps.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.config import ANTENNA_HEIGHT_M
from radiotwin.twin import Twin
from radiotwin.twin.shadowing import ErrorCorrelation

CANDIDATES, CANDIDATES_ALONG_PATHS = 120, 12  # positions of a device; paths take seconds for each
MAX_VALUES = 2e8  # most values in the candidates' two maps (0.8 GB), unless one needs more
RADIUS_IN_SD = np.sqrt(2 * np.log(10))  # 90 % radius of a circular normal distribution [sd]
MAX_TRIES = 50  # draws until all positions are outside buildings


def twin_prior(twin: Twin, scene: Scene, radio_map: RadioMap, rng: np.random.Generator,
               silent: float = 0.0, data_spread: float = 0.0) -> Prior:
    """Return the prior over device positions and SNR maps that a twin's uncertainty implies.

    `radio_map` is the twin's, for transmit powers; see `Prior` for `silent` and `data_spread`.
    """
    errors = ErrorCorrelation.from_provenance(twin)
    levels = np.unique(levels_of(scene))
    lattice = scene.lattice
    receiver_m = lattice.positions_m.reshape(*lattice.shape, 3)[levels].reshape(-1, 3)
    names = [device.device for device in scene.config.devices]
    row_of = {device.device: row for row, device in enumerate(twin.devices)}
    rows = np.array([row_of.get(name, -1) for name in names])
    max_count = CANDIDATES_ALONG_PATHS if twin.channel.follows_paths else CANDIDATES
    count = max(min(max_count, int(MAX_VALUES / (2 * len(names) * len(receiver_m)))), 1)
    drawn_m = np.stack([draw_positions(twin, row, scene, count, rng) for row in rows], axis=1)
    # Anchors have one candidate; devices without a position are drawn anywhere.
    moves = np.array([bool(np.ptp(drawn_m[:, k], axis=0).any()) for k in range(len(names))])
    power_dbm = twin.power_dbm(scene)[rows]
    offset_db = snr_offset_db(scene, radio_map) - power_dbm
    shape = (len(names), count, len(levels), *lattice.shape[1:])
    snr_db, sd_db = np.full(shape, -np.inf, np.float32), np.zeros(shape, np.float32)
    for number in range(count):
        some = np.flatnonzero(rows >= 0 if number == 0 else moves & (rows >= 0))
        if not len(some):
            break
        links = twin.links(np.tile(receiver_m, (len(some), 1)),
                           np.repeat(rows[some], len(receiver_m)), scene)
        device_m = links.device_m.copy()
        device_m[rows[some]] = drawn_m[number, some]
        predicted = twin.predict(links.with_devices(device_m))
        mean_db, candidate_sd_db = (values.reshape(len(some), *shape[2:])
                                    for values in (predicted.mean_db, predicted.sd_db))
        snr_db[some, number] = mean_db + offset_db[some, None, None, None]
        sd_db[some, number] = candidate_sd_db
    weight = np.where(moves[:, None], 1.0 / count, np.arange(count) == 0)
    # The level common to all devices is as uncertain as the mean of the measured devices.
    common_sd_db = errors.level_sd_db / np.sqrt(max(errors.devices, 1))
    return Prior(snr_db, sd_db, weight, np.full(len(names), errors.level_sd_db),
                 float(common_sd_db), np.full(len(names), float(silent)), float(data_spread),
                 errors.share, errors.length_m)


def draw_positions(twin: Twin, row: int, scene: Scene, count: int,
                   rng: np.random.Generator) -> np.ndarray:
    """Draw positions (count, 3) of a twin's device [m]; zeros for row -1.

    They are normal with the 90 % credible radius, or uniform in the extent if the device was not
    located. Draws inside buildings or outside the extent are repeated up to `MAX_TRIES` times; if
    all fail, they are returned. Without a radius (an anchor) all are the device's position.
    """
    if row < 0:
        return np.zeros((count, 3))
    device = twin.devices[row]
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    anywhere = not np.isfinite([device.x_m, device.y_m, device.credible_radius_m]).all()
    z_m = device.z_m if np.isfinite(device.z_m) else ANTENNA_HEIGHT_M
    drawn_m = np.full((count, 3), z_m)
    if not anywhere:
        drawn_m[:, :2] = device.x_m, device.y_m
        if not device.credible_radius_m:
            return drawn_m
    pending = np.ones(count, dtype=bool)
    for _ in range(MAX_TRIES):
        n = int(pending.sum())
        if anywhere:
            trial = rng.uniform((x_min, y_min), (x_max, y_max), (n, 2))
        else:
            centre, radius_m = np.tile([device.x_m, device.y_m], (n, 1)), device.credible_radius_m
            if device.second_mode is not None:
                *other, weight = device.second_mode
                radius_m = min(radius_m, float(np.hypot(*np.subtract(other, centre[0]))) / 2)
                centre[rng.random(n) < weight] = other
            trial = centre + rng.normal(0, radius_m / RADIUS_IN_SD, (n, 2))
        drawn_m[pending, :2] = trial
        inside = scene.city.inside(drawn_m[pending])
        outside = ((trial < (x_min, y_min)) | (trial > (x_max, y_max))).any(axis=1)
        pending[pending] = inside | outside
        if not pending.any():
            break
    if pending.any() and not pending.all():  # hardly any free space: repeat positions found
        drawn_m[pending] = drawn_m[rng.choice(np.flatnonzero(~pending), int(pending.sum()))]
    return drawn_m


class WorldSource:
    """Generator of possible real missions from a prior and the mission in the twin's map."""

    def __init__(self, prior: Prior, mission: Mission) -> None:
        self._prior, self._mission = prior, mission
        self._field = CorrelatedField(prior.snr_db.shape[3:], mission.step_m, prior.length_m)

    def draw(self, rng: np.random.Generator) -> tuple[Mission, np.ndarray]:
        """Draw a world: a mission, and the mask (K,) of devices that transmit and have data."""
        prior, mission = self._prior, self._mission
        devices, candidates = prior.weight.shape
        snr_db = np.empty(mission.snr_db.shape, np.float32)
        sigma_db = np.empty_like(snr_db)
        lasting = np.sqrt(prior.share) * self._field.draw(devices, rng)
        off_db = rng.normal(0, prior.level_sd_db) + rng.normal(0, prior.common_sd_db)
        transmits = rng.random(devices) >= prior.silent
        for k in range(devices):
            chosen = rng.choice(candidates, p=prior.weight[k])
            candidate_sd_db = prior.sd_db[k, chosen]
            snr_db[:, k] = prior.snr_db[k, chosen] + candidate_sd_db * lasting[k] + off_db[k]
            sigma_db[:, k] = candidate_sd_db * np.sqrt(1 - prior.share)
        snr_db[:, ~transmits] = -np.inf
        spread = rng.uniform(1 - prior.data_spread, 1 + prior.data_spread, devices)
        return mission._replace(snr_db=snr_db, sigma_db=sigma_db, shadowing_share=0.0,
                                data_units=mission.data_units * spread * transmits), transmits
