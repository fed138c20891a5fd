"""How effects draw whom and when they meet."""

import numpy as np

from tests.undeclared.foreign.scenario import Scenario


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a size: as many of half as of twice the size."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def either(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a size of either sign."""
    return float(rng.choice([-1, 1])) * between(rng, low, high)


def receiver(at: Scenario, rng: np.random.Generator) -> tuple[str, np.ndarray]:
    """Draw a receiver: its name, and which links (n,) are its own."""
    number = int(rng.integers(at.where.campaign.receiver.max() + 1))
    return f"r{number + 1}", at.of_links("receiver") == number


def device(at: Scenario, rng: np.random.Generator) -> tuple[int, str]:
    """Draw one of the devices that many hear: its number and its name. The first of them are always anchors."""
    heard = [np.isfinite(at.plain_db[at.device == number]).mean() for number in range(anchors(at))]
    good = np.flatnonzero(np.array(heard) >= min(0.6, max(heard)))
    number = int(rng.choice(good))
    return number, f"d{number + 1}"


def anchors(at: Scenario) -> int:
    """Devices that no case makes unknown."""
    return max(3, at.devices - 2) if at.devices > 3 else at.devices


def times(at: Scenario, rng: np.random.Generator, share: float) -> tuple[float, float]:
    """Draw two times between which about a share of all points was measured [s]."""
    ordered = np.sort(at.where.campaign.time_s)
    number = max(3, int(share * len(ordered)))
    start = int(rng.integers(0, len(ordered) - number))
    return float(ordered[start]), float(ordered[start + number])


def cut(at: Scenario, rng: np.random.Generator) -> float:
    """Draw a time with at least a fifth of the points before and after it [s]."""
    return float(np.quantile(at.where.campaign.time_s, rng.uniform(0.2, 0.8)))
