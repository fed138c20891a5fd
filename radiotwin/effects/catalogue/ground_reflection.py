"""`ground_reflection`: interference of the direct ray with the one reflected by the ground.

Two rays over a plane earth (Goldsmith 2005, 'Wireless Communications', Sec. 2.4.1): the field
relative to the direct ray's is 1 + s R exp(-2 (k σ sin ψ)²) (d / d') exp(-j k (d' - d)), with d'
from the device's image, R Fresnel's coefficient for vertical polarisation over medium dry ground
(ITU-R P.2040-4, Table 3), ψ the angle between ray and ground, and the exponential for a surface of
roughness σ (Ament 1953, 'Toward a theory of reflection by a rough surface', Proc. IRE 41). An error
σ of the heights blurs the fringes by the same factor on average.

On terrain the plane is the tangent plane at the point of reflection.
"""

import numpy as np
from pydantic import Field
from scipy.constants import speed_of_light
from typing_extensions import override

from radiotwin.effects.arrays import MIN_NATS, squares_about_mean, subsample
from radiotwin.effects.base import GainEffect, ResidualView
from radiotwin.effects.params import EffectParams, Estimate, Metres, Parameter, Variation
from radiotwin.links import Links
from radiotwin.scene.citymap import CityMap
from radiotwin.scene.materials import permittivity

MIN_LINKS = 100  # with line of sight
MAX_PROPOSE_LINKS = 3000  # drawn at random for the proposal
MAX_PROPOSALS = 2
# Grid of trial values; roughness and height in wavelengths, the height within MAX_HEIGHT_M.
STRENGTHS = (0.3, 0.6, 1.0)
ROUGHNESSES = (0.05, 0.2)
HEIGHTS = np.arange(-32, 33) / 8
MAX_HEIGHT_M = 0.5  # largest height of the ground above or below the declared one
MAX_STRENGTH = 2.0  # of metal at steep angles, relative to medium dry ground
MIN_END_HEIGHT_M = 0.1  # least height of both ends above the ground
SLOPE_M = 5.0  # half of the distance over which the slope of the terrain is taken
BOUNCE_ROUNDS = 8  # iterations to find the point of reflection on terrain
OFF_GROUND_M = 1.0  # distance of that point from the terrain above which there is no reflection
BOUNCE_M = 0.2  # the point is raised so much for its lines of sight: the ground would block them
DEEPEST_DB = -30.0  # deepest fringe that is ever measured


class GroundReflection(GainEffect):
    """One ground for all links with line of sight whose bounce no building blocks."""

    name = "ground_reflection"
    in_words = "reflection off the ground"
    acts_on = ("distance", "direction")
    parameter_labels = {"roughness_m": "ground roughness", "ground_m": "ground height"}
    settled_by = "vary the height over open ground"
    needs_frequency = True
    confused_with = ("antenna_pattern", "wall_reflection")

    class Params(EffectParams):
        """A plane ground."""

        strength: float = Field(
            ge=-100, le=100, description="Of the reflection, relative to smooth medium dry ground.")
        roughness_m: float = Field(
            ge=0, le=1000, description="Standard deviation of the surface's height [m].")
        ground_m: Metres = Field(description="Height of the plane [m].")
        wavelength_m: float = Field(
            gt=0, le=1000, description="Of the radio; scales steps and bounds of the search [m].")

    params: Params

    @override
    def unavailable(self, links: Links) -> str | None:
        """Return why no ground reflection can be fitted (frequency, or few links in sight)."""
        if missing := super().unavailable(links):
            return missing
        if links.los.sum() < MIN_LINKS:
            return f"fewer than {MIN_LINKS} links have line of sight"
        return None

    @override
    def propose(self, view: ResidualView) -> list[Params]:
        """Propose ground height, roughness and strength of a reflection that fit the residuals."""
        rows = subsample(np.flatnonzero(view.links.los), MAX_PROPOSE_LINKS)
        part, weight = view.links.select(rows), view.weight[rows]
        links_per_row = view.links.los.sum() / max(len(rows), 1)
        wavelength_m = speed_of_light / part.frequency_hz

        def squares(offset_db: np.ndarray | float) -> float:
            return squares_about_mean(view.residual_db[rows] - offset_db, weight)

        before, best = squares(0.0), []
        heights_m = HEIGHTS[np.abs(HEIGHTS * wavelength_m) <= MAX_HEIGHT_M] * wavelength_m
        for ground_m in heights_m.tolist():
            tried = [self.Params(strength=strength, roughness_m=roughness * wavelength_m,
                                 ground_m=ground_m, wavelength_m=wavelength_m)
                     for strength in STRENGTHS for roughness in ROUGHNESSES]
            nats = [0.5 * links_per_row * (before - squares(self.with_params(params).gain_db(part)))
                    for params in tried]
            best.append((max(nats), tried[int(np.argmax(nats))]))
        best = [pair for pair in sorted(best, key=lambda pair: -pair[0]) if pair[0] > MIN_NATS]
        return [params for _, params in best[:MAX_PROPOSALS]]

    @override
    def gain_db(self, links: Links) -> np.ndarray:
        """Compute the level (n,) of both rays over the direct one [dB]; 0 if one is blocked."""
        offset_db = np.zeros(len(links))
        clear, device_m, receiver_m = self.of_links.get(links, None, lambda: _bounces(links))
        rows = np.flatnonzero(clear)
        offset_db[rows] = two_ray_db(
            device_m[rows], receiver_m[rows], links.frequency_hz,
            self.params.strength, self.params.roughness_m, self.params.ground_m)
        return offset_db

    @override
    def variation(self) -> Variation:
        """Put the reflection's strength, roughness and ground height [m] into a search vector."""
        names, wavelength_m = ("strength", "roughness_m", "ground_m"), self.params.wavelength_m
        return Variation(
            np.array([getattr(self.params, name) for name in names]),
            np.array([0.2, 0.05 * wavelength_m, 0.08 * wavelength_m]),
            np.array([0.0, 0.0, -2 * MAX_HEIGHT_M]),
            np.array([MAX_STRENGTH, wavelength_m, 2 * MAX_HEIGHT_M]),
            lambda numbers: self.changed(**dict(zip(names, numbers.tolist(), strict=True))))

    @override
    def parameters(self, links: Links, estimate: Estimate) -> dict[str, Parameter]:
        units = {"strength": "of medium dry ground", "roughness_m": "m", "ground_m": "m"}
        return self.variation().parameters(units, estimate.params_sd)


def _bounces(links: Links) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find which links (n,) have a ground reflection, and both ends (n, 3) above its plane [m]."""
    device_m = links.device_m[links.device]
    if links.city is not None and links.city.terrain is not None:
        return bounces_on_terrain(links.city, device_m, links.receiver_m, links.los)
    return _has_bounce(links), device_m, links.receiver_m


def bounces_on_terrain(city: CityMap, device_m: np.ndarray, receiver_m: np.ndarray,
                       los: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the ground reflection between n pairs of ends on terrain.

    Fixed-point iteration: reflect at the tangent plane of a point, then take the tangent plane at
    the point of reflection.

    Args:
        city: 3D map with a terrain.
        device_m: (n, 3) first ends [m].
        receiver_m: (n, 3) second ends [m].
        los: (n,) bool, links with line of sight; others have no reflection.

    Returns:
        (n,) bool, whether there is an unblocked reflection; and both ends (n, 3) in the frame of
        its plane: z above it, the first end at x = y = 0, the second at y = 0 [m].
    """
    height_m = [np.maximum(end_m[:, 2] - city.ground_height_m(*end_m[:, :2].T), MIN_END_HEIGHT_M)
                for end_m in (device_m, receiver_m)]
    share = height_m[0] / (height_m[0] + height_m[1])
    bounce_m = device_m + share[:, None] * (receiver_m - device_m)
    for _ in range(BOUNCE_ROUNDS):
        touch_m = np.column_stack([bounce_m[:, :2], city.ground_height_m(*bounce_m[:, :2].T)])
        normal = _slope_normals(city, touch_m)
        above_m = [np.einsum("ij,ij->i", end_m - touch_m, normal)
                   for end_m in (device_m, receiver_m)]
        sum_m = np.maximum(above_m[0] + above_m[1], MIN_END_HEIGHT_M)
        share = np.clip(above_m[0] / sum_m, 0.0, 1.0)
        feet_m = [end_m - height[:, None] * normal
                  for end_m, height in zip((device_m, receiver_m), above_m)]
        bounce_m = feet_m[0] + share[:, None] * (feet_m[1] - feet_m[0])
    off_m = np.abs(bounce_m[:, 2] - city.ground_height_m(*bounce_m[:, :2].T))
    clear = los & (off_m < OFF_GROUND_M) & (np.minimum(*above_m) >= MIN_END_HEIGHT_M)
    raised_m = bounce_m + (BOUNCE_M + off_m)[:, None] * [0.0, 0.0, 1.0]
    clear[clear] = (city.line_of_sight(device_m[clear], raised_m[clear])
                    & city.line_of_sight(raised_m[clear], receiver_m[clear]))
    flat_m, none = np.linalg.norm(feet_m[1] - feet_m[0], axis=1), np.zeros(len(device_m))
    return (clear, np.column_stack([none, none, above_m[0]]),
            np.column_stack([flat_m, none, above_m[1]]))


def _slope_normals(city: CityMap, points_m: np.ndarray) -> np.ndarray:
    """Compute unit normals (n, 3), upward, of the terrain, from its slope over ±`SLOPE_M`."""
    rise = []
    for aside_m in SLOPE_M * np.eye(2):
        forth, back = points_m[:, :2] + aside_m, points_m[:, :2] - aside_m
        rise.append((city.ground_height_m(*forth.T) - city.ground_height_m(*back.T))
                    / (2 * SLOPE_M))
    normal = np.column_stack([-rise[0], -rise[1], np.ones(len(points_m))])
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _has_bounce(links: Links) -> np.ndarray:
    """Check which links (n,) have a direct ray and an unblocked reflection off flat ground."""
    clear = links.los.copy()
    if links.city is not None:
        a_m, b_m = links.device_m[links.device[clear]], links.receiver_m[clear]
        share = a_m[:, 2:] / np.maximum(a_m[:, 2:] + b_m[:, 2:], MIN_END_HEIGHT_M)
        bounce_m = a_m + share * (b_m - a_m)
        bounce_m[:, 2] = BOUNCE_M
        clear[clear] = (links.city.line_of_sight(a_m, bounce_m)
                        & links.city.line_of_sight(bounce_m, b_m))
    return clear


def two_ray_db(device_m: np.ndarray, receiver_m: np.ndarray, frequency_hz: float, strength: float,
               roughness_m: float, ground_m: float) -> np.ndarray:
    """Compute the level (n,) of direct plus reflected ray over the direct, ≥ `DEEPEST_DB` [dB].

    Args:
        device_m: (n, 3) positions of the devices [m].
        receiver_m: (n, 3) positions of the receivers [m].
        frequency_hz: carrier frequency [Hz].
        strength: reflection coefficient relative to smooth medium dry ground.
        roughness_m: standard deviation of the surface's height [m].
        ground_m: height of the plane; ends count as `MIN_END_HEIGHT_M` above it or more [m].
    """
    from radiotwin.propagation.paths.interactions import (  # imported late: loads numba
        VACUUM_PERMITTIVITY_F_M,
        fresnel,
    )

    heights_m = [np.maximum(end_m[:, 2] - ground_m, MIN_END_HEIGHT_M)
                 for end_m in (device_m, receiver_m)]
    flat_m = np.hypot(*(receiver_m - device_m)[:, :2].T)
    direct_m, bounced_m = (np.maximum(np.hypot(flat_m, heights_m[1] + sign * heights_m[0]), 1.0)
                           for sign in (-1, 1))
    wave_number = 2 * np.pi * frequency_hz / speed_of_light
    real, conductivity_s_m, _ = permittivity("medium_dry_ground", frequency_hz)
    imaginary = conductivity_s_m / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY_F_M)
    sine = np.minimum((heights_m[0] + heights_m[1]) / bounced_m, 1.0)
    roughness = np.exp(-2 * (wave_number * roughness_m * sine) ** 2)
    bounce = (strength * fresnel(sine, complex(real, -imaginary))[1] * roughness
              * direct_m / bounced_m)
    field = np.abs(1 + bounce * np.exp(-1j * wave_number * (bounced_m - direct_m)))
    return 20 * np.log10(np.maximum(field, 10 ** (DEEPEST_DB / 20)))
