"""Line-of-sight queries per second on one core, as a ratio to the exact test against every box.

    python benchmarks/line_of_sight.py [--links 2000000]

Links go from random ground positions of the RBM preset to random UAV positions. The reference is a vectorised slab
test against all of the city's boxes, on fewer links.
"""

import argparse
import time

import numpy as np

from radiotwin.scene.citymap import CityMap
from radiotwin.scene.generator import building_meshes
from radiotwin.scene.presets import preset_boxes


def random_links(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    ground_m = np.column_stack([rng.uniform(0, 600, n), rng.uniform(0, 800, n), np.full(n, 1.5)])
    air_m = np.column_stack([rng.uniform(0, 600, n), rng.uniform(0, 800, n), rng.choice([55.0, 60.0, 65.0], n)])
    return ground_m, air_m


def exact(a_m: np.ndarray, b_m: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    los = np.ones(len(a_m), dtype=bool)
    direction = b_m - a_m
    for x0, y0, x1, y1, height in boxes:
        near, far = (np.array([x0, y0, 0.0]) - a_m) / direction, (np.array([x1, y1, height]) - a_m) / direction
        enter, leave = np.minimum(near, far).max(axis=1), np.maximum(near, far).min(axis=1)
        los &= ~((enter < leave) & (leave > 0) & (enter < 1))
    return los


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--links", type=int, default=2_000_000)
    links = parser.parse_args().links
    import trimesh

    boxes = preset_boxes("rbm")
    mesh = trimesh.util.concatenate(building_meshes(boxes))
    city, rng = CityMap(mesh.vertices, mesh.faces), np.random.default_rng(0)
    a_m, b_m = random_links(links, rng)
    city.line_of_sight(a_m[:1000], b_m[:1000])
    start = time.process_time()
    los = city.line_of_sight(a_m, b_m)
    ray_s = (time.process_time() - start) / links
    few = slice(0, links // 20)
    start = time.process_time()
    reference = exact(a_m[few], b_m[few], boxes)
    box_s = (time.process_time() - start) / len(reference)
    outside = ~city.inside(a_m[few])
    differ = (los[few] != reference)[outside].mean()
    print(f"3D map       {1e-6 / ray_s:8.2f} million links a second of one core")
    print(f"exact boxes  {1e-6 / box_s:8.2f} million links a second of one core")
    print(f"ratio        {box_s / ray_s:8.1f}   (answers differ on {differ:.4%} of the links)")


if __name__ == "__main__":
    main()
