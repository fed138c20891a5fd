"""Heights of receivers that were probably meant from another zero: the sea's, or the ground's."""

import numpy as np

from radiotwin.scene import Scene

MAX_FLOWN_M = 500.0  # above the ground: more than three times what UAVs may (120 m, EU 2019/947)
HIGH_M = 200.0  # above the ground, from which altitudes above the sea are suspected
_NEARLY_ALL = 0.95  # of the receivers


def height_notes(receiver_m: np.ndarray, scene: Scene) -> list[str]:
    """Return a note where heights look as if they counted from another zero than the scene's.

    Args:
        receiver_m: (n, 3), z above the datum of the scene [m]; NaN where unknown.
        scene: the 3D map.
    """
    known = np.isfinite(receiver_m).all(axis=1)
    if not known.any():
        return []
    z_m = receiver_m[known, 2]
    clearance_m = z_m - scene.city.ground_height_m(*receiver_m[known, :2].T)
    origin = scene.config.origin
    datum_m = 0.0 if origin is None else origin.altitude_m
    if np.mean(clearance_m < 0) > 0.5:
        for raised_m, remedy in (
                (z_m, "the scene's z counts from its datum, so add the ground's height"),
                (z_m + datum_m, "import them as height, not as altitude")):
            if np.mean((raised_m >= 0) & (raised_m <= MAX_FLOWN_M)) >= _NEARLY_ALL:
                low_m, high_m = raised_m.min(), raised_m.max()
                return [f"most receivers are below the ground; {low_m:.0f} to {high_m:.0f} m would "
                        f"be plausible as heights above the ground: if they are, {remedy}"]
        return ["most receivers are below the ground, by up to "
                f"{-clearance_m.min():.0f} m: is the altitude of the ground right (--origin "
                "LAT,LON,ALT), and is it above the same zero (the sea's level and the ellipsoid "
                "are tens of metres apart)?"]
    lowest_m = float(np.quantile(clearance_m, 1 - _NEARLY_ALL))
    if lowest_m > HIGH_M:
        return [f"receivers are {lowest_m:.0f} m and more above the ground: if those are altitudes "
                "above the sea, import them as altitude, with the ground's in --origin LAT,LON,ALT"]
    return []
