"""What each case hides: a deck of families for either split, dealt to the worlds where they make sense."""

import json
from collections import Counter
from functools import cache
from pathlib import Path

import numpy as np

from tests.undeclared.foreign import air, electronics, ends, places
from tests.undeclared.foreign.layouts import CITIES, SPLITS, city
from tests.undeclared.foreign.worlds import WORLDS, World, world, world_name

CASES = 5  # of each world
DEALT = Path(__file__).parent / "dealt.json"
RAIN_HZ = 20e9  # below, rain takes next to nothing from 400 m

DRAWS = {draw.__name__: draw for draw in (
    electronics.receiver_gain_offset, electronics.device_gain_offset, electronics.receiver_drift,
    electronics.device_drift, electronics.receiver_saturation, electronics.noise_floor, electronics.lock_loss,
    electronics.faulty_flight, electronics.episode, electronics.agc_hysteresis, electronics.heater_cycle,
    ends.sector_antenna, ends.tilted_dipole, ends.body_shadowing, ends.mover, ends.antenna_swap, ends.swaying_antenna,
    air.foliage, air.excess_attenuation, air.shower, air.interference, air.duty_cycled_jammer, air.warm_front,
    air.wet_walls, air.standing_waves, places.missing_obstacle, places.removed_obstacle,
    places.device_position_error, places.receiver_clock_offset)}
SINGLES = {
    "receiver_gain_offset": 4, "device_gain_offset": 3, "receiver_drift": 4, "device_drift": 3,
    "receiver_saturation": 2, "noise_floor": 2, "receiver_clock_offset": 3, "sector_antenna": 3, "tilted_dipole": 2,
    "body_shadowing": 3, "foliage": 4, "excess_attenuation": 2, "missing_obstacle": 4, "removed_obstacle": 3,
    "device_position_error": 4, "interference": 2, "lock_loss": 2, "faulty_flight": 4, "episode": 4}
OUTSIDE = {"mover": 4, "duty_cycled_jammer": 3, "warm_front": 3, "antenna_swap": 3, "shower": 2, "wet_walls": 3,
           "agc_hysteresis": 3, "standing_waves": 2, "swaying_antenna": 2, "heater_cycle": 2}
PAIRS = (("missing_obstacle", "receiver_drift"), ("sector_antenna", "device_position_error"),
         ("foliage", "receiver_gain_offset"), ("device_gain_offset", "episode"), ("removed_obstacle", "faulty_flight"),
         ("receiver_gain_offset", "device_drift"), ("interference", "receiver_clock_offset"),
         ("body_shadowing", "device_gain_offset"), ("lock_loss", "missing_obstacle"))
MIXED = (("mover", "receiver_gain_offset"), ("warm_front", "sector_antenna"), ("heater_cycle", "foliage"),
         ("wet_walls", "device_gain_offset"), ("antenna_swap", "missing_obstacle"), ("duty_cycled_jammer", "receiver_drift"))
TIMED = {"receiver_drift", "device_drift", "receiver_clock_offset", "episode", "mover", "duty_cycled_jammer", "shower",
         "wet_walls", "agc_hysteresis", "heater_cycle", "swaying_antenna", "lock_loss"}
ATTITUDE = {"tilted_dipole", "body_shadowing", "antenna_swap"}


def hands() -> list[tuple[str, ...]]:
    """Return what the cases of one split hide, none to two families each: as many as it has cases."""
    single = [(name,) for counts in (SINGLES, OUTSIDE) for name, count in counts.items() for _ in range(count)]
    found = [*single, *PAIRS, *MIXED]
    return found + [()] * (CITIES // 2 * WORLDS * CASES - len(found))


@cache
def dealt() -> dict[str, tuple[str, ...]]:
    """Return the families that each case hides, by its name; dealt before any world was traced."""
    return {name: tuple(hand) for name, hand in json.loads(DEALT.read_text()).items()}


def deal(split: str) -> dict[str, tuple[str, ...]]:
    """Deal the deck to the cases of a split: slow, as all its worlds are drawn for it."""
    rng = np.random.default_rng([SPLITS.index(split), 11])
    worlds = [world(world_name(number, w)) for w in range(WORLDS) for number in range(CITIES)
              if city(number).split == split]
    cards = [hands()[index] for index in rng.permutation(len(hands()))]
    able = {card: [where for where in worlds if all(makes_sense(name, where) for name in card)] for card in set(cards)}
    cards.sort(key=lambda card: len(able[card]))  # those that few worlds can have are dealt first
    held: dict[str, list[tuple[str, ...]]] = {where.name: [] for where in worlds}
    for card in cards:
        room = [where.name for where in able[card] if len(held[where.name]) < CASES]
        if not room:
            raise ValueError(f"no world of {split} is left for {card}")
        repeats = Counter({name: 3 * held[name].count(card) + len(held[name]) for name in room})
        least = min(repeats.values())
        held[str(rng.choice([name for name in room if repeats[name] == least]))].append(card)
    return {f"{name}-c{number}": held[name][index] for name in held
            for number, index in enumerate(rng.permutation(CASES))}


def makes_sense(family: str, where: World) -> bool:
    """Return whether a family can be seen at all in a world."""
    campaign, is_rain, is_low = where.campaign, where.frequency_hz > RAIN_HZ, where.frequency_hz < RAIN_HZ
    flights, receivers = campaign.flight.max() + 1, campaign.receiver.max() + 1
    return {"excess_attenuation": is_rain, "shower": is_rain, "foliage": is_low, "standing_waves": is_low,
            "swaying_antenna": is_low, "receiver_gain_offset": receivers > 1, "antenna_swap": flights >= 4,
            "faulty_flight": flights >= 3, "device_gain_offset": len(where.device_m) > 4,
            "receiver_clock_offset": any(kind in ("drive", "fly") for kind in campaign.kind)}.get(family, True)


def write_dealt() -> None:
    """Write `dealt.json`, a case a line."""
    hands_of = {name: hand for split in SPLITS for name, hand in deal(split).items()}
    lines = ",\n".join(f"{json.dumps(name)}: {json.dumps(hands_of[name])}" for name in sorted(hands_of))
    DEALT.write_text(f"{{\n{lines}\n}}\n")
