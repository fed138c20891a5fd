"""Tune `marl.heuristics.WEIGHTS` on generated missions, and judge them on others.

    python -m studies.heuristic

Cross-entropy method: weights are drawn around a mean, and the best of them give the next mean.
"""

import numpy as np

from marl.flights import Policy, evaluate
from marl.heuristics import HeuristicPolicy
from marl.mission import Mission
from studies.generated import generated_mission

MISSIONS, GENERATIONS, DRAWS, KEPT = 20, 40, 16, 5
MEAN = np.array([0.3, 2.0, 3.0, 0.3, 0.5, 0.5, 0.1, 0.5, 0.5])
SPREAD = np.array([0.3, 1.0, 2.0, 0.3, 0.5, 0.5, 0.1, 0.7, 0.7])


def drawn_mission(seed: int) -> Mission:
    """Draw 1 to 5 UAVs, 6 to 15 devices, batteries of 40 to 80 and 8,000 to 20,000 data units."""
    rng = np.random.default_rng([7, seed])
    return generated_mission(1000 + seed, int(rng.integers(1, 6)), int(rng.integers(6, 16)),
                             battery=float(rng.uniform(40, 80)),
                             data_units=float(rng.uniform(8000, 20000)))


def share(policy: Policy, mission: Mission) -> float:
    """Return the share that a policy collects, mean of two flights."""
    return float(evaluate(mission, policy, 2, np.random.default_rng(1)).ratio(mission).mean())


def main() -> None:
    """Print the weights, and what they collect over what greedy does."""
    missions = [drawn_mission(seed) for seed in range(2 * MISSIONS)]
    greedy = np.array([share(HeuristicPolicy("greedy", np.random.default_rng(0)), mission)
                       for mission in missions])

    def worth(weights: np.ndarray, which: slice) -> float:
        shares = [share(HeuristicPolicy("heuristic", rng, weights), mission)
                  for mission in missions[which]]
        return float(np.mean(np.array(shares) / greedy[which]))

    rng, mean, spread = np.random.default_rng(0), MEAN, SPREAD
    for _ in range(GENERATIONS):
        drawn = [np.maximum(mean + spread * rng.standard_normal(len(mean)), 0)
                 for _ in range(DRAWS)]
        order = np.argsort([worth(weights, slice(MISSIONS)) for weights in drawn])
        best = np.array([drawn[i] for i in order[-KEPT:]])
        mean = 0.3 * mean + 0.7 * best.mean(axis=0)
        spread = 0.3 * spread + 0.7 * best.std(axis=0) + 0.01
    print(mean.round(2).tolist(), f"{worth(mean, slice(MISSIONS)):.3f} x greedy,",
          f"{worth(mean, slice(MISSIONS, None)):.3f} on missions that were not tuned on")


if __name__ == "__main__":
    main()
