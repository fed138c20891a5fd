"""How many rays a city needs: a few links solved with more and more of them."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from radiotwin.errors import BadInput, RunFailed
from radiotwin.pieces import kept
from radiotwin.progress import progress
from radiotwin.scene import Scene
from radiotwin.trace.noise import noise_figures
from radiotwin.trace.run import device_indices
from radiotwin.trace.settings import FINER, QUALITIES, SolverSettings
from radiotwin.trace.solver import IMPOSSIBLE_DB, PathGains

TARGETS_DB = (0.05, 20.0)
_CALLS, _POINTS = 4, 40  # links of the pilot: calls, each of one device and so many points
_MIN_LINKS = 20  # detected ones, without which an RMS says nothing


@dataclass(frozen=True)
class Rung:
    """Numerical error and cost of a quality on the pilot's links.

    Attributes:
        quality: `fast`, `default` or `high`.
        settings: Its settings.
        links: Links that are detected with its rays and with ten times as many.
        rms_db: RMS of the differences of their gains [dB].
        p90_db: 90th percentile of the absolute differences [dB].
        bias_db: Mean of the gains minus those with ten times the rays [dB].
        seconds_per_link: Duration of a full batch over its number of links [s].
    """

    quality: str
    settings: SolverSettings
    links: int
    rms_db: float
    p90_db: float
    bias_db: float
    seconds_per_link: float


def choose_quality(scene: Scene, points_m: np.ndarray, target_db: float,
                   devices: list[str] | None = None, **others: str | int | float | None
                   ) -> list[Rung]:
    """Find the quality with the fewest rays whose numerical error is within a target.

    160 links between the devices and the points outdoors are drawn by the settings' seed, so that
    the same question has the same answer. They are solved with each quality, from the fewest rays
    on, and again with ten times its rays, until the RMS difference of detected links is within the
    target. It is the figure that `noise_floor_db` of a traced map estimates from 1 % of the map.
    Within `keep_pieces` each quality's gains are kept.

    Args:
        scene: City, devices and radio.
        points_m: (n, 3) positions of the receivers [m].
        target_db: Highest RMS difference [dB].
        devices: Names; None: all devices of the scene.
        others: Fields of `SolverSettings` that differ from the qualities'.

    Returns:
        The qualities that were tried; the last one reaches the target.

    Raises:
        BadInput: A target outside 0.05 to 20 dB, or that no quality reaches; an unknown device;
            the solver `map`.
        RunFailed: Too few of the links are detected; no usable libLLVM.
    """
    low_db, high_db = TARGETS_DB
    if not low_db <= target_db <= high_db:
        raise BadInput(f"target_db = {target_db:g}: allowed is {low_db:g} to {high_db:g} dB")
    if others.get("solver", "paths") != "paths":
        raise BadInput("the error target needs the solver 'paths'; give a quality instead")
    index = device_indices(scene, devices)
    outdoors_m = points_m[~scene.city.inside(points_m)]
    if not len(outdoors_m):
        raise BadInput(f"all {len(points_m)} points are inside buildings: nothing to estimate an "
                       "error from; give a quality instead of a target")
    tried: list[Rung] = []
    with progress("numerical error of a few links", total=len(QUALITIES)) as advance:
        for quality in QUALITIES:
            settings = SolverSettings.of_quality(quality, **others)
            tried.append(_try(scene, quality, settings, _calls(outdoors_m, index, settings.seed)))
            advance(1)
            if tried[-1].rms_db <= target_db:
                return tried
    figures = ", ".join(f"{rung.quality} {rung.rms_db:.2f} dB" for rung in tried)
    raise BadInput(f"target_db = {target_db:g}: no quality reaches it here; RMS differences from "
                   f"ten times the rays, over {tried[-1].links} links: {figures}. Give a larger "
                   f"target, or --quality {tried[-1].quality}")


def _calls(points_m: np.ndarray, index: Sequence[int], seed: int
           ) -> list[tuple[int, np.ndarray]]:
    """Draw (device, points) of the pilot's calls."""
    rng = np.random.default_rng([seed, len(points_m), *index])
    devices = np.resize(rng.permutation(index), _CALLS)
    count = min(_POINTS, len(points_m))
    return [(int(device), points_m[np.sort(rng.choice(len(points_m), count, replace=False))])
            for device in devices]


def _try(scene: Scene, quality: str, settings: SolverSettings,
         calls: list[tuple[int, np.ndarray]]) -> Rung:
    solved = [kept("pilot", (scene.content_hash(), one.attributes(), *calls),
                   partial(_solve, scene, one, calls),
                   lambda found: ({"found": found}, None), lambda arrays, _: arrays["found"])
              for one in (settings, settings.finer(FINER))]
    coarse, finer = solved[0][:-1], solved[1][:-1]
    both = np.isfinite(coarse) & np.isfinite(finer)
    if both.sum() < _MIN_LINKS:
        raise RunFailed(f"of {coarse.size} links of the pilot {both.sum()} are detected; at least "
                        f"{_MIN_LINKS} are needed to estimate an error: give more points, or a "
                        "quality instead of a target")
    figures = noise_figures(coarse, finer)
    return Rung(quality, settings, int(both.sum()), float(figures["noise_floor_db"]),
                float(figures["noise_floor_p90_db"]), float(np.mean((coarse - finer)[both])),
                float(solved[0][-1]))


def _solve(scene: Scene, settings: SolverSettings, calls: list[tuple[int, np.ndarray]]
           ) -> np.ndarray:
    """Return the gains of all calls [dB], NaN where not detected, then the seconds a link."""
    solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, settings)
    gains, seconds = [], []
    for device, points_m in calls:
        started = time.perf_counter()
        gains.append(solver.gains(scene.device_m[device], points_m,
                                  (scene.device_antennas[device], scene.uav_antenna)))
        solved = len(solver.batches(len(points_m))) * settings.batch_receivers
        seconds.append((time.perf_counter() - started) / solved)
    gain_db = np.concatenate(gains)
    gain_db[(gain_db < scene.config.gain_limit_db) | (gain_db == IMPOSSIBLE_DB)] = np.nan
    return np.append(gain_db, np.median(seconds[1:]))  # the first one compiles the kernels
