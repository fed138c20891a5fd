"""What stands or hangs in the air along a link and is put on top of a traced gain: trees, and a hazy layer."""

import numpy as np

from tests.undeclared.cities import SIDE_M, buildings
from tests.undeclared.shapes import distance_m, turned
from tests.undeclared.worlds import World

TREE_SPACING_M = 6.0
STEM_M = 2.0  # below the crown


def foliage(world: World, rng: np.random.Generator) -> dict:
    """Two groves that no map shows, each around free ground near a device, as an entry of the answer.

    `trees` are (x, y, radius, height) [m]: their crowns are spheroids from above the stem to the top.
    """
    groves: list[dict] = []
    used: list[np.ndarray] = []
    while len(groves) < 2:
        device = int(rng.integers(len(world.device_m)))
        away_m, turn = rng.uniform(10, 30), rng.uniform(0, 2 * np.pi)
        centre = world.device_m[device, :2] + away_m * np.array([np.cos(turn), np.sin(turn)])
        apart = all(np.hypot(*(centre - other)) > 110 for other in used)
        if not (40 <= centre.min() <= centre.max() <= SIDE_M - 40 and apart):
            continue
        widths, height_m, lean = rng.uniform(40, 80, 2), rng.uniform(8, 15), rng.uniform(0, np.pi)
        trees = _trees(world.city, centre, widths, height_m, lean, rng)
        if len(trees) >= 20:
            used.append(centre)
            groves.append({"centre_m": centre.round(1).tolist(), "widths_m": widths.round(1).tolist(),
                           "turn_deg": round(float(np.degrees(lean)), 1), "height_m": round(height_m, 1),
                           "trees": trees.round(2).tolist()})
    return {"name": "foliage", "groves": groves, "most_db": round(float(rng.uniform(15, 25)), 1),
            "first_db_per_m": round(float(rng.uniform(0.7, 1.3)), 2)}


def _trees(city: str, centre: np.ndarray, widths: np.ndarray, height_m: float, lean: float,
           rng: np.random.Generator) -> np.ndarray:
    """(t, 4) trees on a jittered lattice within an ellipse, where there is no building."""
    half = widths.max() / 2
    steps = np.arange(-half, half, TREE_SPACING_M)
    places = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    places = places + rng.uniform(-1.5, 1.5, places.shape)
    places = places[((places / (widths / 2)) ** 2).sum(axis=1) < 1]
    places = turned(places, lean) + centre
    on_ground = np.ones(len(places), dtype=bool)
    for building in buildings(city):
        if np.hypot(*(building.footprint_m - centre).T).min() < half + 60:
            on_ground &= distance_m(places, building.footprint_m) > 1.0
    places = places[on_ground]
    return np.column_stack([places, rng.uniform(2.6, 4.2, len(places)), height_m * rng.uniform(0.8, 1, len(places))])


def foliage_loss_db(effect: dict, device_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """(k, p) loss of links that saturates with the metres of crown on them [dB]."""
    trees = np.concatenate([grove["trees"] for grove in effect["groves"]])
    middle = np.column_stack([trees[:, :2], (trees[:, 3] + STEM_M) / 2])
    half = np.column_stack([trees[:, 2], trees[:, 2], (trees[:, 3] - STEM_M) / 2])
    metres = np.stack([_crown_m(one_m, points_m, middle, half) for one_m in device_m])
    return effect["most_db"] * np.tanh(effect["first_db_per_m"] * metres / effect["most_db"])


def _crown_m(device_m: np.ndarray, points_m: np.ndarray, middle: np.ndarray, half: np.ndarray) -> np.ndarray:
    """(p,) metres of the segments from a device to points within spheroids (t, 3); where two overlap, twice."""
    start = (device_m - middle) / half  # in a frame where the crown is a unit sphere
    along = (points_m - device_m)[:, None] / half
    a, b, c = (along**2).sum(-1), (along * start).sum(-1), (start**2).sum(-1) - 1
    root = np.sqrt(np.maximum(b**2 - a * c, 0))
    share = np.clip((-b + root) / a, 0, 1) - np.clip((-b - root) / a, 0, 1)
    return share.sum(axis=1) * np.linalg.norm(points_m - device_m, axis=1)


def excess_attenuation(world: World, rng: np.random.Generator) -> dict:
    """Haze that thins out with height takes power from every link."""
    return {"name": "excess_attenuation", "ground_db_per_km": round(float(rng.uniform(25, 45)), 1),
            "scale_height_m": round(float(rng.uniform(25, 60)), 1)}


def haze_loss_db(effect: dict, device_m: np.ndarray, points_m: np.ndarray) -> np.ndarray:
    """(k, p) loss of links through haze of exponentially falling density [dB]."""
    scale_m = effect["scale_height_m"]
    low, high = device_m[:, None, 2], points_m[None, :, 2]
    length_km = np.linalg.norm(points_m[None] - device_m[:, None], axis=-1) / 1000
    mean = scale_m * (np.exp(-low / scale_m) - np.exp(-high / scale_m)) / (high - low)
    return effect["ground_db_per_km"] * length_km * mean
