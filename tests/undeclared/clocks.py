"""A receiver whose levels and places are written down by two clocks."""

import numpy as np

from tests.undeclared.worlds import SLOTS, UAVS, World


def receiver_clock_offset(world: World, rng: np.random.Generator) -> dict:
    """The places beside one receiver's levels are those of one to four seconds before, or after."""
    late_s = rng.choice([-1, 1]) * rng.uniform(1, 4)
    return {"name": "receiver_clock_offset", "receiver": f"uav{rng.integers(UAVS)}", "late_s": round(float(late_s), 2)}


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
