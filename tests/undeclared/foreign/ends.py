"""Effects at the ends of links, by directions: antennas, bodies, and what stands or moves close by."""

import numpy as np

from tests.undeclared.foreign.draws import between, device, receiver, times
from tests.undeclared.foreign.scenario import Hidden, Scenario


def sector_antenna(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device's panel: a column of elements, each a raised cosine, with a ripple and a back lobe."""
    number, name = device(at, rng)
    azimuth_deg, downtilt_deg = rng.uniform(0, 360), rng.choice([0.0, rng.uniform(2, 12)])
    sharpness, elements, back_db = rng.uniform(0.8, 4.0), int(rng.integers(1, 7)), -between(rng, 8, 30)
    ripple = rng.normal(0, rng.uniform(0, 0.6), 4)

    def gain_db(elevation: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
        off = azimuth - np.radians(90 - azimuth_deg)
        lobe = np.clip(0.5 + 0.5 * np.cos(off), 1e-9, 1)**(2 * sharpness)
        phase = np.pi * 0.7 * (np.sin(elevation) + np.sin(np.radians(downtilt_deg)))
        array = np.abs(np.exp(1j * np.outer(phase, np.arange(elements))).mean(axis=1))**2 * np.cos(elevation)**2
        waves = sum(size * np.cos((order + 2) * off + order) for order, size in enumerate(ripple))
        return 10 * np.log10(lobe * array + 10**(back_db / 10)) + waves

    # Lossless: its gain averages to one over all directions.
    sines, turns = np.meshgrid(np.linspace(-1, 1, 60)[1:-1], np.linspace(0, 2 * np.pi, 72, endpoint=False))
    mean_db = 10 * np.log10(np.mean(10**(gain_db(np.arcsin(sines.ravel()), turns.ravel()) / 10)))
    turn = np.radians(np.arange(0, 180.0))
    cut_db = gain_db(np.full(180, -np.radians(downtilt_deg)), turn + np.radians(90 - azimuth_deg))
    cut_db = cut_db - cut_db[0]
    mine = at.device[at.paths.link] == number
    change_db = np.where(mine, gain_db(*at.paths.leaves_rad.T) - mean_db, 0.0)
    return Hidden("antenna_pattern", True, {
        "kind": "sector", "device": name, "azimuth_deg": round(azimuth_deg, 1), "downtilt_deg": round(downtilt_deg, 1),
        "beamwidth_deg": 2.0 * float(np.argmax(cut_db < -3)) if (cut_db < -3).any() else 360.0,
        "front_to_back_db": round(float(-cut_db[-1]), 1)}, path_db=change_db)


def tilted_dipole(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A short dipole at a receiver, tilted in its body's frame; waves arrive upright, bounced ones less so."""
    name, mine = receiver(at, rng)
    tilt_deg, towards_deg = float(rng.choice([0.0, rng.uniform(15, 80)], p=[0.2, 0.8])), rng.uniform(0, 360)
    heading = np.radians(at.of_links("heading_deg") + towards_deg)[at.paths.link]
    tilt = np.radians(tilt_deg)
    axis = np.column_stack([np.sin(tilt) * np.sin(heading), np.sin(tilt) * np.cos(heading),
                            np.full(len(heading), np.cos(tilt))])
    elevation, azimuth = at.paths.arrives_rad.T
    upright = np.column_stack([-np.sin(elevation) * np.cos(azimuth), -np.sin(elevation) * np.sin(azimuth),
                               np.cos(elevation)])
    across = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))])
    crossed = np.where(at.paths.bounces > 0, 0.15, 0.01)
    power = 1.5 * (((axis * upright).sum(axis=1))**2 * (1 - crossed) + crossed * ((axis * across).sum(axis=1))**2)
    return Hidden("antenna_pattern", True,
                  {"kind": "dipole", "receiver": name, "tilt_deg": round(tilt_deg, 1),
                   "tilt_towards_deg": round(towards_deg, 1)},
                  path_db=np.where(mine[at.paths.link], 10 * np.log10(power + 1e-3), 0.0))


def body_shadowing(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A body beside a receiver's antenna takes most from what comes through it: a smooth lobe in its frame."""
    name, mine = receiver(at, rng)
    depth_db, width_deg = between(rng, 3, 20), rng.uniform(30, 75)
    towards_deg, below_deg = rng.uniform(0, 360), rng.uniform(-10, 30)
    elevation, azimuth = at.paths.arrives_rad.T
    relative = np.pi / 2 - azimuth - np.radians(at.of_links("heading_deg")[at.paths.link] + towards_deg)
    low = -np.radians(below_deg)
    cosine = np.sin(elevation) * np.sin(low) + np.cos(elevation) * np.cos(low) * np.cos(relative)
    off_deg = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    return Hidden("body_shadowing", True, {
        "receiver": name, "depth_db": round(depth_db, 2), "direction_deg": round(towards_deg, 1),
        "below_deg": round(below_deg, 1), "width_deg": round(width_deg, 1)},
        path_db=-np.where(mine[at.paths.link], depth_db * np.exp(-0.5 * (off_deg / width_deg)**2), 0.0))


def mover(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A lorry that parks beside a device now and then: in a part of the horizon low paths lose power."""
    number, name = device(at, rng)
    loss_db, towards, half = between(rng, 6, 20), rng.uniform(-np.pi, np.pi), np.radians(rng.uniform(25, 70))
    when = np.zeros(at.links, dtype=bool)
    for _ in range(int(rng.integers(1, 4))):
        start_s, end_s = times(at, rng, rng.uniform(0.1, 0.3))
        when |= (at.of_links("time_s") >= start_s) & (at.of_links("time_s") < end_s)
    elevation, azimuth = at.paths.leaves_rad.T
    off = np.abs((azimuth - towards + np.pi) % (2 * np.pi) - np.pi)
    behind = (at.device == number)[at.paths.link] & when[at.paths.link] & (off < half) & (elevation < np.radians(35))
    return Hidden("mover", False, {"device": name, "loss_db": round(loss_db, 1), "half_width_deg": round(np.degrees(half)),
                                   "azimuth_deg": round(float(90 - np.degrees(towards)) % 360)},
                  path_db=-loss_db * behind)


def antenna_swap(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A receiver flies with a patch that looks ahead and down in some flights, with a whip in the others."""
    name, mine = receiver(at, rng)
    flights = np.unique(at.of_links("flight")[mine])
    patch = rng.permutation(flights)[:max(1, len(flights) // 2)]
    elevation, azimuth = at.paths.arrives_rad.T
    off = np.pi / 2 - azimuth - np.radians(at.of_links("heading_deg")[at.paths.link])
    towards = np.cos(elevation) * np.cos(off) * np.cos(0.5) - np.sin(elevation) * np.sin(0.5)
    patch_db = 10 * np.log10(np.clip(towards, 0.03, 1)**2 * 4.5)
    whip_db = 10 * np.log10(1.5 * np.cos(elevation)**2 + 0.02)
    is_patch = np.isin(at.of_links("flight"), patch)[at.paths.link]
    return Hidden("antenna_swap", False, {"receiver": name, "flights": [f"f{number + 1}" for number in sorted(patch)]},
                  path_db=np.where(mine[at.paths.link], np.where(is_patch, patch_db, whip_db), 0.0))


def swaying_antenna(at: Scenario, rng: np.random.Generator) -> Hidden:
    """A device's narrow beam swings in the wind."""
    number, name = device(at, rng)
    swing, period_s = np.radians(rng.uniform(10, 35)), rng.uniform(5, 60)
    towards = rng.uniform(-np.pi, np.pi) + swing * np.sin(2 * np.pi * at.of_links("time_s") / period_s)
    off = at.paths.leaves_rad[:, 1] - towards[at.paths.link]
    beam_db = 10 * np.log10((0.5 + 0.5 * np.cos(off))**8 + 0.02) + 5
    return Hidden("swaying_antenna", False, {"device": name, "swing_deg": round(np.degrees(swing), 1),
                                             "period_s": round(period_s, 1)},
                  path_db=np.where((at.device == number)[at.paths.link], beam_db, 0.0))
