"""Effects between the ends of links: groves, rain, emitters, and what weather does to walls and beams."""

import numpy as np

from tests.undeclared.foreign.draws import between, times
from tests.undeclared.foreign.grounds import Grounds
from tests.undeclared.foreign.scenario import Hidden, Scenario


def foliage(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A grove: crowns as ellipsoids, denser inside, through which each path loses so much a metre."""
    ghz = at.where.frequency_hz / 1e9
    per_m_db = 0.35 * ghz**0.35 * between(rng, 0.5, 2.5)
    most_db = rng.uniform(14, 35)
    middle_m, number = _grove_middle(at, rng), int(rng.integers(4, 12))
    crowns_m = np.column_stack([middle_m + rng.normal(0, rng.uniform(6, 16), (number, 2)),
                                rng.uniform(5, 11, number)])
    radii_m = np.column_stack([np.repeat(rng.uniform(3, 7, (number, 1)), 2, axis=1), rng.uniform(3, 7, number)])
    weighted_m = sum(_inside_m(start, end, crowns_m, radii_m) for start, end in _legs(at))
    loss_db = most_db * np.tanh(per_m_db * weighted_m / most_db)
    return Hidden("foliage", True, {
        "centre_m": crowns_m.mean(axis=0).round(1).tolist(), "per_metre_db": round(per_m_db, 3),
        "most_db": round(most_db, 1), "x_m": [float((crowns_m - radii_m)[:, 0].min()), float((crowns_m + radii_m)[:, 0].max())],
        "y_m": [float((crowns_m - radii_m)[:, 1].min()), float((crowns_m + radii_m)[:, 1].max())]}, path_db=-loss_db)


def _grove_middle(at: Scenario, rng: np.random.Generator) -> np.ndarray:
    """(2,) near a device's lines to its receivers, in the open."""
    ground = Grounds(at.where.city)
    for _ in range(500):
        link = int(rng.integers(at.links))
        a_m, b_m = at.where.device_m[at.device[link]], at.where.campaign.points_m[at.point[link]]
        share = rng.uniform(0.05, 0.95)
        point = a_m + share * (b_m - a_m)
        if point[2] < 14 and ground.room_m(point[None, :2])[0] > 6 and np.hypot(*(point - a_m)[:2]) > 8:
            return point[:2]
    return ground.free_point(rng, 6.0)


def _legs(at: Scenario) -> list[tuple[np.ndarray, np.ndarray]]:
    """Corners of the paths' legs (q, 3) [m]: the first, the last, and one between them for all that there are."""
    link = at.paths.link
    a_m, b_m = at.where.device_m[at.device[link]], at.where.campaign.points_m[at.point[link]]
    first_m = a_m + at.paths.first_m[:, None] * _vectors(at.paths.leaves_rad)
    last_m = b_m + at.paths.last_m[:, None] * _vectors(at.paths.arrives_rad)
    direct = (at.paths.bounces == 0)[:, None]
    return [(a_m, np.where(direct, b_m, first_m)), (np.where(direct, b_m, first_m), np.where(direct, b_m, last_m)),
            (np.where(direct, b_m, last_m), b_m)]


def _vectors(angles_rad: np.ndarray) -> np.ndarray:
    elevation, azimuth = angles_rad.T
    return np.column_stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])


def _inside_m(start_m: np.ndarray, end_m: np.ndarray, crowns_m: np.ndarray, radii_m: np.ndarray) -> np.ndarray:
    """(q,) length of legs in crowns, summed over crowns, less where they only graze them [m]."""
    total_m, way_m = np.zeros(len(start_m)), end_m - start_m
    length_m = np.linalg.norm(way_m, axis=1)
    for crown_m, radius_m in zip(crowns_m, radii_m):
        p, d = (start_m - crown_m) / radius_m, way_m / radius_m
        a, b, c = (d * d).sum(axis=1) + 1e-12, (p * d).sum(axis=1), (p * p).sum(axis=1) - 1
        root = np.sqrt(np.maximum(b * b - a * c, 0))
        share = np.clip((-b + root) / a, 0, 1) - np.clip((-b - root) / a, 0, 1)
        total_m += share * length_m * root / np.sqrt(a)
    return total_m


def lengths_m(at: Scenario) -> np.ndarray:
    """(q,) lengths of paths, the middle of those of three and more bounces as a straight line [m]."""
    return sum(np.linalg.norm(end - start, axis=1) for start, end in _legs(at))


def excess_attenuation(at: Scenario, rng: np.random.Generator) -> Hidden:
    """Steady rain over the whole campaign and city, by the length of each path."""
    per_km_db = between(rng, 4, 28)
    return Hidden("excess_attenuation", True, {"per_km_db": round(per_km_db, 2)},
                  path_db=-per_km_db * lengths_m(at) / 1000)


def shower(at: Scenario, rng: np.random.Generator) -> Hidden:
    """Rain that sets in during the campaign, gets heavy and stops, by the length of each path."""
    per_km_db, (start_s, end_s) = between(rng, 10, 40), times(at, rng, rng.uniform(0.2, 0.5))
    share = np.clip((at.of_links("time_s") - start_s) / (end_s - start_s), 0, 1)
    return Hidden("shower", False, {"per_km_db": round(per_km_db, 1), "start_s": start_s, "end_s": end_s},
                  path_db=-per_km_db * lengths_m(at) / 1000 * np.sin(np.pi * share)[at.paths.link])


def interference(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device that nobody declares sends all the time."""
    over_db = _emitter_over_db(at, rng, 0.03, 0.4)
    return Hidden("interference", True, {"centre_m": at.where.device_m[-1].tolist(), "over_a_device_db": round(over_db, 1)},
                  adds_db=at.spare_db[at.point] + over_db)


def duty_cycled_jammer(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device that nobody declares sends in bursts."""
    over_db, period_s, duty = _emitter_over_db(at, rng, 0.05, 0.4), between(rng, 4, 90), rng.uniform(0.2, 0.6)
    on = (at.of_links("time_s") / period_s + rng.random()) % 1 < duty
    return Hidden("duty_cycled_jammer", False, {"centre_m": at.where.device_m[-1].tolist(), "period_s": round(period_s, 1),
                                                "duty": round(duty, 2)},
                  adds_db=np.where(on, at.spare_db[at.point] + over_db, -np.inf))


def _emitter_over_db(at: Scenario, rng: np.random.Generator, least: float, most: float) -> float:
    """How much more the emitter sends than a device, so that it is the stronger in a share of the links [dB]."""
    spare_db = at.spare_db[at.point]
    both = np.isfinite(at.plain_db) & np.isfinite(spare_db)
    return float(np.quantile(at.plain_db[both] - spare_db[both], between(rng, least, most)))


def warm_front(at: Scenario, rng: np.random.Generator) -> Hidden:
    """Layers bend beams: over distance, and slowly in time, levels wander up and down."""
    size_db, scale_m, hours = between(rng, 1.5, 6), rng.uniform(120, 350), rng.uniform(600, 4000)
    way_m = at.where.device_m[at.device] - at.where.campaign.points_m[at.point]
    phase = 2 * np.pi * (np.linalg.norm(way_m, axis=1) / scale_m + at.of_links("time_s") / hours + rng.random())
    return Hidden("warm_front", False, {"size_db": round(size_db, 2), "scale_m": round(scale_m)},
                  air_db=size_db * np.sin(phase))


def wet_walls(at: Scenario, rng: np.random.Generator) -> Hidden:
    """After a shower walls and ground are wet: each bounce costs more or less than before."""
    each_db, from_s = -rng.choice([-1, 1, 1]) * between(rng, 1, 5), float(np.quantile(at.where.campaign.time_s, 0.5))
    wet = (at.of_links("time_s") >= from_s)[at.paths.link]
    return Hidden("wet_walls", False, {"each_bounce_db": round(float(each_db), 2), "from_s": from_s},
                  path_db=each_db * at.paths.bounces * wet)


def standing_waves(at: Scenario, rng: np.random.Generator) -> Hidden:
    """Readings of a narrow carrier: fields add, not powers, so that levels fade over parts of a wavelength."""
    wave_m = 299_792_458.0 / at.where.frequency_hz
    phase = 2 * np.pi * (lengths_m(at) / wave_m) + rng.uniform(0, 2 * np.pi, len(at.paths.link))
    fields = 10**(at.paths.power_db / 20) * np.exp(1j * phase)
    real, imaginary = (np.bincount(at.paths.link, part, at.links) for part in (fields.real, fields.imag))
    with np.errstate(divide="ignore", invalid="ignore"):
        change_db = 10 * np.log10(real**2 + imaginary**2) - at.plain_db
    return Hidden("standing_waves", False, {}, air_db=np.nan_to_num(change_db, nan=0.0, posinf=0.0, neginf=-40.0))
