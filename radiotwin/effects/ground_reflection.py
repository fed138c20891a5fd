"""The ray that bounces off the ground interferes with the direct one: fringes over distance and height.

Two rays over a plane earth (Goldsmith 2005, 'Wireless Communications', Sec. 2.4.1): the field relative to the direct
ray's is 1 + s R exp(-2 (k σ sin ψ)²) (d / d') exp(-j k (d' - d)), with d' from the device's image, R Fresnel's
coefficient for vertical polarisation over medium dry ground (ITU-R P.2040-4, Table 3), ψ the angle between ray and
ground, and the exponential for a surface of roughness σ (Ament 1953, 'Toward a theory of reflection by a rough
surface', Proc. IRE 41). Heights that are known to σ only smear the fringes by the same factor, on average.
"""

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.effects.base import Effect, Parameter, Term, Variation, View, some
from radiotwin.paths.coefficients import VACUUM_PERMITTIVITY_F_M, fresnel
from radiotwin.scene.materials import permittivity

LEAST_LINKS = 100
LEAST_NATS = 4.0
LEAST_HEIGHT_M = 0.1
BOUNCE_M = 0.2  # above the ground: where a bounce must be seen from, that the ground itself does not hide it
DEEPEST_DB = -30.0
ENOUGH_LINKS = 3000
STARTS = 2
STRENGTHS = (0.3, 0.6, 1.0)
STRONGEST = 2.0  # metal, at steep angles
ROUGHNESS = (0.05, 0.2)  # wavelengths
GROUNDS = np.arange(-32, 33) / 8  # wavelengths
FARTHEST_M = 0.5


class GroundReflection(Effect):
    """One ground for all links with line of sight whose bounce no building hides."""

    name = "ground_reflection"
    confused_with = ("antenna_pattern", "wall_reflection")

    def __init__(self):
        self._seen = None

    def lacks(self, records) -> str | None:
        if not np.isfinite(records.frequency_hz):
            return "the frequency is not known; give frequency_hz in devices.csv"
        if records.los.sum() < LEAST_LINKS:
            return f"fewer than {LEAST_LINKS} links have line of sight"
        return None

    def propose(self, view: View) -> list[dict]:
        rows = some(np.flatnonzero(view.records.los), ENOUGH_LINKS)
        part, weight = view.records.select(rows), view.weight[rows]
        share = view.records.los.sum() / max(len(rows), 1)
        wavelength_m = speed_of_light / part.frequency_hz

        def squares(offset_db):
            rest = view.residual_db[rows] - offset_db
            return weight @ (rest - weight @ rest / weight.sum()) ** 2

        before, best = squares(0.0), []
        for ground_m in GROUNDS[np.abs(GROUNDS * wavelength_m) <= FARTHEST_M] * wavelength_m:
            tried = [{"strength": strength, "roughness_m": rough * wavelength_m, "ground_m": float(ground_m),
                      "wavelength_m": wavelength_m} for strength in STRENGTHS for rough in ROUGHNESS]
            gains = [0.5 * share * (before - squares(self._offset_db(part, setting))) for setting in tried]
            best.append((max(gains), tried[int(np.argmax(gains))]))
        best = [pair for pair in sorted(best, key=lambda pair: -pair[0]) if pair[0] > LEAST_NATS]
        return [setting for _, setting in best[:STARTS]]

    def term(self, records, setting, at) -> Term:
        return Term.of_offset(self._offset_db(records, setting))

    def vary(self, setting) -> Variation:
        wavelength_m = setting["wavelength_m"]
        return Variation(
            np.array([setting[name] for name in ("strength", "roughness_m", "ground_m")]),
            np.array([0.2, 0.05 * wavelength_m, 0.08 * wavelength_m]),
            np.array([0.0, 0.0, -2 * FARTHEST_M]), np.array([STRONGEST, wavelength_m, 2 * FARTHEST_M]),
            lambda numbers: setting | dict(zip(("strength", "roughness_m", "ground_m"), map(float, numbers))))

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        names = (("strength", "of medium dry ground"), ("roughness_m", "m"), ("ground_m", "m"))
        return {name: Parameter.normal(setting[name], spread, unit)
                for (name, unit), spread in zip(names, found.setting_deviations)}

    def _offset_db(self, records, setting) -> np.ndarray:
        offset_db = np.zeros(len(records))
        rows = np.flatnonzero(self._bounces(records))
        offset_db[rows] = two_ray_db(
            records.device_m[records.device[rows]], records.receiver_m[rows], records.frequency_hz,
            setting["strength"], setting["roughness_m"], setting["ground_m"])
        return offset_db

    def _bounces(self, records) -> np.ndarray:
        """(n,) bool, whether nothing stands in the way of either ray; kept, as it is asked again for each setting."""
        if self._seen is None or self._seen[0] is not records:
            sees = records.los.copy()
            if records.city is not None:
                a_m, b_m = records.device_m[records.device[sees]], records.receiver_m[sees]
                share = a_m[:, 2:] / np.maximum(a_m[:, 2:] + b_m[:, 2:], LEAST_HEIGHT_M)
                bounce_m = a_m + share * (b_m - a_m)
                bounce_m[:, 2] = BOUNCE_M
                sees[sees] = records.city.line_of_sight(a_m, bounce_m) & records.city.line_of_sight(bounce_m, b_m)
            self._seen = records, sees
        return self._seen[1]


def two_ray_db(device_m: np.ndarray, receiver_m: np.ndarray, frequency_hz: float, strength: float, roughness_m: float,
               ground_m: float) -> np.ndarray:
    """(n,) level of both rays over that of the direct one [dB].

    Args:
        device_m, receiver_m: (n, 3) ends [m].
        strength: of the reflection, relative to smooth medium dry ground.
        roughness_m: standard deviation of the surface's height [m].
        ground_m: height of the plane [m].
    """
    heights_m = [np.maximum(end_m[:, 2] - ground_m, LEAST_HEIGHT_M) for end_m in (device_m, receiver_m)]
    flat_m = np.hypot(*(receiver_m - device_m)[:, :2].T)
    direct_m, bounced_m = (np.maximum(np.hypot(flat_m, heights_m[1] + sign * heights_m[0]), 1.0) for sign in (-1, 1))
    wave_number = 2 * np.pi * frequency_hz / speed_of_light
    real, conductivity_s_m, _ = permittivity("medium_dry_ground", frequency_hz)
    ground = complex(real, -conductivity_s_m / (2 * np.pi * frequency_hz * VACUUM_PERMITTIVITY_F_M))
    sine = np.minimum((heights_m[0] + heights_m[1]) / bounced_m, 1.0)
    bounce = strength * fresnel(sine, ground)[1] * np.exp(-2 * (wave_number * roughness_m * sine) ** 2) \
        * direct_m / bounced_m
    field = np.abs(1 + bounce * np.exp(-1j * wave_number * (bounced_m - direct_m)))
    return 20 * np.log10(np.maximum(field, 10 ** (DEEPEST_DB / 20)))
