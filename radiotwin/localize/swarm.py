"""Particle swarm search for the most likely positions, all swarms of all devices in one batch."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Clerc & Kennedy 2002, "The particle swarm: explosion, stability, and convergence in a
# multidimensional complex space", IEEE Trans. Evol. Comput. 6(1), eq. (4.1)-(4.2): phi is
# 2.05 + 2.05, which gives chi = 2 / (phi - 2 + sqrt(phi^2 - 4 phi)); a velocity is
# chi (v + 2.05 u1 (own best - x) + 2.05 u2 (swarm's best - x)).
PHI_EACH = 2.05
CONSTRICTION = 2.0 / (2 * PHI_EACH - 2.0 + np.sqrt((2 * PHI_EACH) ** 2 - 8 * PHI_EACH))


def distinct_modes(xy_m: np.ndarray, log_likelihood: np.ndarray, n_modes: int,
                   separation_m: float) -> np.ndarray:
    """Return the best of scanned positions that keep a distance from each other.

    Args:
        xy_m: (p, 2) positions [m].
        log_likelihood: (p,) [nats]; -inf where no device may be.
        n_modes: number of positions, at most.
        separation_m: least distance between two of them [m].

    Returns:
        (at most n_modes, 2) [m], best first.
    """
    modes = np.empty((0, 2))
    left = np.isfinite(log_likelihood)
    while left.any() and len(modes) < n_modes:
        best = xy_m[np.argmax(np.where(left, log_likelihood, -np.inf))]
        modes = np.vstack([modes, best])
        left &= np.linalg.norm(xy_m - best, axis=1) >= separation_m
    return modes


def swarm_search(
    log_likelihood: Callable[[np.ndarray, np.ndarray], np.ndarray],
    centre_m: np.ndarray,
    device: np.ndarray,
    anywhere_m: np.ndarray,
    start_sd_m: float,
    particles: int,
    iterations: int,
    rng: np.random.Generator,
    advance: Callable[[int], None] = lambda n: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Run s swarms and return the best position that each found.

    Two thirds of a swarm start around its centre, the first particle at the centre itself, and the
    others anywhere, so that a swarm can leave a poor mode.

    Args:
        log_likelihood: maps positions (p, 2) and devices (p,) to (p,) [nats], -inf where no device
            may be.
        centre_m: (s, 2) start of each swarm [m].
        device: (s,) device that each swarm looks for.
        anywhere_m: (a, 2) positions where the other third may start [m].
        start_sd_m: standard deviation of starts around a centre [m].
        particles: of each swarm.
        iterations: of every swarm.
        rng: random state.
        advance: called with 1 after each iteration.

    Returns:
        (s, 2) best positions [m], and their log-likelihoods (s,) [nats].
    """
    s = len(centre_m)
    x = centre_m[:, None] + start_sd_m * rng.standard_normal((s, particles, 2))
    x[:, 0] = centre_m
    n_far = particles // 3
    x[:, particles - n_far :] = anywhere_m[rng.integers(len(anywhere_m), size=(s, n_far))]
    v = start_sd_m * rng.uniform(-1.0, 1.0, x.shape)
    whose = np.repeat(device, particles)
    own_best, own_value = x.copy(), log_likelihood(x.reshape(-1, 2), whose).reshape(s, particles)
    for _ in range(iterations):
        best = own_best[np.arange(s), own_value.argmax(axis=1)][:, None]
        u1, u2 = rng.random((2, s, particles, 2))
        v = CONSTRICTION * (v + PHI_EACH * (u1 * (own_best - x) + u2 * (best - x)))
        x = x + v
        value = log_likelihood(x.reshape(-1, 2), whose).reshape(s, particles)
        better = value > own_value
        own_best[better], own_value[better] = x[better], value[better]
        advance(1)
    best = own_value.argmax(axis=1)
    return own_best[np.arange(s), best], own_value[np.arange(s), best]
