"""Faults of a receiver or a device, as its electronics would make them; each acts on the levels (k, p) of one."""

import numpy as np

from tests.undeclared.worlds import SLOTS, UAVS, World


def receiver_gain_offset(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """One receiver reads 4 to 8 dB too much or too little."""
    offset_db = rng.choice([-1, 1]) * rng.uniform(4, 8)
    return {"name": "receiver_gain_offset", "receiver": _one(rng), "offset_db": round(float(offset_db), 2)}


def warm_up(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """One receiver's gain moves by 3 to 6 dB while its amplifier gets warm."""
    final_db = rng.choice([-1, -1, 1]) * rng.uniform(3, 6)
    return {"name": "receiver_drift", "kind": "warm_up", "receiver": _one(rng), "final_db": round(float(final_db), 2),
            "time_constant_s": round(float(rng.uniform(150, 600)), 1)}


def step(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """A connector gives way at some slot: from then on one receiver reads 3 to 6 dB less (or, mended, more)."""
    flight = int(rng.integers(1, 5))
    slot = int(rng.integers(5, SLOTS - 5))
    time_s = world.time_s[world.flight == flight][slot]
    return {"name": "receiver_drift", "kind": "step", "receiver": _one(rng), "time_s": float(time_s),
            "step_db": round(float(rng.choice([-1, -1, 1]) * rng.uniform(3, 6)), 2)}


def device_change(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """Between two flights one device's antenna breaks off (or is mended): 4 to 8 dB."""
    flight = int(rng.integers(2, 5))
    return {"name": "device_drift", "kind": "step", "device": _device(world, rng),
            "time_s": float(world.time_s[world.flight == flight].min()),
            "step_db": round(float(rng.choice([-1, -1, 1]) * rng.uniform(4, 8)), 2)}


def battery(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """One device's battery sinks, and its power with it, by 5 to 9 dB from the first slot to the last."""
    return {"name": "device_drift", "kind": "ageing", "device": _device(world, rng),
            "last_db": round(float(-rng.uniform(5, 9)), 2)}


def receiver_saturation(world: World, rng: np.random.Generator, clean_db: np.ndarray) -> dict:
    """One receiver's amplifier compresses the strongest tenth to quarter of its links."""
    receiver = _one(rng)
    levels_db = clean_db[:, world.receiver == _number(receiver)]
    saturation_db = np.nanquantile(levels_db, 1 - rng.uniform(0.1, 0.25))
    return {"name": "receiver_saturation", "receiver": receiver, "saturation_db": round(float(saturation_db), 2),
            "knee": round(float(rng.uniform(0.8, 2.0)), 2)}


def receiver_clock_offset(world: World, rng: np.random.Generator) -> dict:
    """The places beside one receiver's levels are those of one to four seconds before, or after."""
    late_s = rng.choice([-1, 1]) * rng.uniform(1, 4)
    return {"name": "receiver_clock_offset", "receiver": _one(rng), "late_s": round(float(late_s), 2)}


def written_m(effect: dict, world: World) -> np.ndarray:
    """(p, 3) the places that are written down [m]; a UAV goes straight on before the first slot and after the last."""
    points_m, late = world.points_m.copy(), effect["late_s"]  # a slot takes a second
    whole = int(np.floor(-late))
    share = -late - whole
    for first in range(0, len(points_m), SLOTS):
        if f"uav{world.receiver[first]}" != effect["receiver"]:
            continue
        track = world.points_m[first:first + SLOTS]
        far = np.arange(1, 10)[:, None]
        longer = np.vstack([track[0] - far[::-1] * (track[1] - track[0]), track,
                            track[-1] + far * (track[-1] - track[-2])])
        there = np.arange(SLOTS) + 9 + whole
        points_m[first:first + SLOTS] = (1 - share) * longer[there] + share * longer[there + 1]
    return points_m.round(2)


def reading_db(effect: dict, world: World, level_db: np.ndarray) -> np.ndarray:
    """What the receivers read (k, p) in place of the level that arrives without the fault (an entry of the answer) [dB]."""
    if "device" in effect:
        faulty = (np.array(world.names) == effect["device"])[:, None]
    else:
        faulty = (world.receiver == _number(effect["receiver"]))[None]
    if effect["name"] == "receiver_gain_offset":
        return level_db + faulty * effect["offset_db"]
    if effect["name"] == "receiver_saturation":
        return np.where(faulty, _compressed(level_db, effect["saturation_db"], effect["knee"]), level_db)
    if effect["kind"] == "ageing":
        return level_db + faulty * effect["last_db"] * world.time_s / world.time_s.max()
    if effect["kind"] == "step":
        return level_db + faulty * (world.time_s >= effect["time_s"]) * effect["step_db"]
    return level_db + faulty * effect["final_db"] * _warmth(world.time_s, effect["time_constant_s"])


def _compressed(level_db: np.ndarray, saturation_db: float, knee: float) -> np.ndarray:
    """Rapp's amplifier: linear far below the saturated output power, which is never passed."""
    over = 10 ** ((level_db - saturation_db) / 10)
    return level_db - 10 * np.log10(1 + over**knee) / knee


def _warmth(time_s: np.ndarray, time_constant_s: float) -> np.ndarray:
    """Share of the final temperature, stepped second by second, on from the first slot (batteries change hot)."""
    warmth = np.zeros(int(time_s.max()) + 2)
    for second in range(1, len(warmth)):
        warmth[second] = warmth[second - 1] + (1 - warmth[second - 1]) / time_constant_s
    return warmth[np.round(time_s).astype(int)]


def _one(rng: np.random.Generator) -> str:
    return f"uav{rng.integers(UAVS)}"


def _device(world: World, rng: np.random.Generator) -> str:
    """An anchor's name."""
    return world.names[rng.choice(np.flatnonzero(world.is_anchor))]


def _number(receiver: str) -> int:
    return int(receiver.removeprefix("uav"))
