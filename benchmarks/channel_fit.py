"""Time to fit and to use each channel model, and what the network's table saves.

    python benchmarks/channel_fit.py

One core, 10,000 links to fit (limit: 20 s for segmented_nn), 1,000,000 to predict. Seconds are of this machine, the
two ratios are of one run: the network's fit over a fixed amount of matrix products, and its predictions through the
ensemble over those through its table.
"""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before numpy and torch start their pools

import time

import numpy as np
import torch

from radiotwin.channel import MODELS, Links
from radiotwin.channel.ensemble import forward

FIT_LINKS, PREDICT_LINKS, LIMIT_DB = 10_000, 1_000_000, -115.0
DEVICE_M = np.array([[60.0, 320.0, 1.5], [320.0, 120.0, 1.5], [580.0, 520.0, 1.5]])


def draw_links(n, rng):
    device = rng.integers(0, len(DEVICE_M), n)
    receiver_m = np.column_stack(
        [rng.uniform(0, 600, n), rng.uniform(0, 800, n), rng.choice([55.0, 60.0, 65.0], n)]
    )
    return Links(DEVICE_M[device], receiver_m, rng.uniform(size=n) < 0.4, device)


def seconds(work, repeats=3):
    """Least of some runs, because other processes only ever add time."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - start)
    return min(times), result


def matrix_products():
    matrix = np.ones((512, 512), np.float32)
    for _ in range(200):
        matrix @ matrix


def through_the_ensemble(model, links, batch=10_000):
    weights = {name: torch.as_tensor(array) for name, array in model.weights.items()}
    place = np.column_stack([links.log_distance, links.receiver_m[:, 2] - links.device_m[:, 2]])
    inputs = torch.as_tensor(model._inputs(place, links.los.astype(int)), dtype=torch.float32)
    with torch.no_grad():
        return torch.cat([forward(weights, rows).mean(0) for rows in inputs.split(batch)])


def main():
    torch.set_num_threads(1)
    rng = np.random.default_rng(0)
    links, many = draw_links(FIT_LINKS, rng), draw_links(PREDICT_LINKS, rng)
    level_db = np.where(links.los, -30 - 25 * links.log_distance, -35 - 30.4 * links.log_distance)
    level_db += np.where(links.los, 2**0.5, 5**0.5) * rng.standard_normal(FIT_LINKS)
    level_db[level_db < LIMIT_DB] = np.nan
    many.log_distance  # computed once, for all models  # noqa: B018

    print(f"{'model':<24}{'fit 10,000 [s]':>16}{'predict [M links/s]':>22}")
    fits, uses, models = {}, {}, {}
    for name, kind in MODELS.items():
        fits[name], models[name] = seconds(lambda kind=kind: kind().fit(links, level_db, LIMIT_DB, seed=0))
        sample = many.select(slice(0, 20_000)) if name == "regression_kriging" else many
        elapsed, _ = seconds(lambda name=name, sample=sample: models[name].predict(sample))
        uses[name] = elapsed / len(sample)
        print(f"{name:<24}{fits[name]:>16.3f}{1e-6 / uses[name]:>22.3f}")

    network = models["segmented_nn"]
    products, _ = seconds(matrix_products)
    sample = many.select(slice(0, 50_000))
    ensemble, _ = seconds(lambda: through_the_ensemble(network, sample))
    print(f"segmented_nn fit / 200 products of 512 x 512: {fits['segmented_nn'] / products:.1f}")
    print(f"segmented_nn ensemble / table, a link: {ensemble / len(sample) / uses['segmented_nn']:.1f}")
    print(f"segmented_nn fit: {fits['segmented_nn']:.1f} s of 20 s allowed")


if __name__ == "__main__":
    main()
