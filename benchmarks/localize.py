"""Localisation against an exhaustive scan in steps of 1 m: seconds, their ratio, and who finds the better optimum.

    python benchmarks/localize.py [--devices 7] [--seed 0]

RBM preset, statistical truth, 915 receiver positions of random-waypoint flights, one core. The scan uses the same
likelihood, with which it costs what it costs; a search that misses the global optimum shows as a positive deficit.
"""

import argparse
import os

os.environ.setdefault("OMP_NUM_THREADS", "1")

import time

import numpy as np

from radiotwin.channel import MODELS, Links, make_links
from radiotwin.localize import LocalizeSettings, localize
from radiotwin.localize.observations import merge_repeats
from radiotwin.localize.search import Search
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.generator import building_meshes
from radiotwin.scene.presets import preset_boxes, preset_config

LIMIT_DB = -120.0


def fly(rng: np.random.Generator) -> np.ndarray:
    """(915, 3) [m]: five flights of three UAVs between random waypoints of the 20 m lattice, 61 slots each."""
    track = []
    for altitude_m in np.repeat([55.0, 60.0, 65.0], 5):
        at = goal = np.array([16, 23])
        for _ in range(61):
            track.append([*(20.0 * at), altitude_m])
            while (goal == at).all():
                goal = np.array([rng.integers(31), rng.integers(41)])
            axis = rng.choice(np.flatnonzero(goal != at))
            at = at + np.sign(goal - at) * (np.arange(2) == axis)
    return np.array(track)


def levels_db(links: Links, rng: np.random.Generator) -> np.ndarray:
    """The published law, NaN below the limit of detection."""
    mean = np.where(links.los, -30 - 25 * links.log_distance, -35 - 30.4 * links.log_distance)
    level = mean + np.where(links.los, 2**0.5, 5**0.5) * rng.standard_normal(len(links))
    return np.where(level < LIMIT_DB, np.nan, level)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--devices", type=int, default=7, help="how many of the preset's unknown devices")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    rng = np.random.default_rng(arguments.seed)
    config = preset_config("rbm")
    meshes = building_meshes(preset_boxes("rbm"))
    offsets = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes])
    city = CityMap(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + offset for mesh, offset in zip(meshes, offsets)]),
    )
    device_m = np.array([(d.x_m, d.y_m, d.z_m) for d in config.devices])
    unknown = np.array([i for i, d in enumerate(config.devices) if d.role == "unknown"])[: arguments.devices]
    track = fly(rng)
    receiver_m, device = (
        np.repeat(track, len(device_m), axis=0),
        np.tile(np.arange(len(device_m)), len(track)),
    )
    links = make_links(device_m, receiver_m, device, city)
    level_db = levels_db(links, rng)
    anchor = ~np.isin(device, [i for i, d in enumerate(config.devices) if d.role == "unknown"])
    channel = MODELS["segmented_nn"]().fit(links.select(anchor), level_db[anchor], LIMIT_DB, arguments.seed)
    bounds = (config.extent.x_min_m, config.extent.x_max_m, config.extent.y_min_m, config.extent.y_max_m)
    z_m = float(device_m[unknown[0], 2])

    started = time.perf_counter()
    found = localize(
        receiver_m, device, level_db, channel,
        devices=unknown, bounds=bounds, z_m=z_m, city=city, limit_db=LIMIT_DB, seed=arguments.seed,
    )  # fmt: skip
    search_s = time.perf_counter() - started
    estimate_m = np.array([(each.x_m, each.y_m) for each in found])
    error_m = np.linalg.norm(estimate_m - device_m[unknown, :2], axis=1)

    observations = merge_repeats(receiver_m, device, level_db, unknown, use_missed=True)
    settings = LocalizeSettings(scan_step_m=1.0, scan_links=10**10)
    exhaustive = Search(
        observations, channel, np.arange(len(unknown)), z_m, bounds, city, LIMIT_DB, settings,
        np.random.default_rng(arguments.seed),
    )  # fmt: skip
    started = time.perf_counter()
    scan = exhaustive.scan()
    scan_s = time.perf_counter() - started
    scan_error_m = np.linalg.norm(scan.point_m[scan.value.argmax(axis=1)] - device_m[unknown, :2], axis=1)
    mine = np.array([exhaustive.log_likelihood(k, estimate_m[k : k + 1])[0] for k in range(len(unknown))])
    deficit = scan.value.max(axis=1) - mine

    print(f"{len(unknown)} devices, {len(observations.receiver_m)} receiver positions, {bounds} m")
    print(
        f"localize               {search_s:8.2f} s   "
        f"error median {np.median(error_m):5.2f} m, worst {error_m.max():5.2f} m"
    )
    print(
        f"exhaustive 1 m scan    {scan_s:8.2f} s   "
        f"error median {np.median(scan_error_m):5.2f} m, worst {scan_error_m.max():5.2f} m"
    )
    print(f"ratio of seconds       {scan_s / search_s:8.2f}")
    print(f"log-likelihood by which the scan beats the estimate, worst device: {deficit.max():.2f} nats")


if __name__ == "__main__":
    main()
