"""Settings of a localisation, and its result."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from radiotwin.twin.localize.likelihood import CHUNK_LINKS


@dataclass(frozen=True)
class LocalizeSettings:
    """Extent of the search.

    Attributes:
        scan_step_m: width of a cell of the first scan over the map [m].
        scan_links: links that the scan may evaluate, beyond which its cells grow.
        swarms: number for each device.
        particles: of each swarm.
        iterations: of every swarm.
        allow_indoor: whether a device may be inside a building.
        chunk_links: links in memory at once (about 100 bytes each).
    """

    scan_step_m: float = 5.0
    scan_links: int = 15_000_000
    swarms: int = 6
    particles: int = 12
    iterations: int = 25
    allow_indoor: bool = False
    chunk_links: int = CHUNK_LINKS


@dataclass(frozen=True)
class TwinDevice:
    """A device as a twin knows it.

    Attributes:
        device: its name.
        x_m, y_m, z_m: declared position of an anchor, estimate of an unknown device [m]; NaN where
            nothing is known of it.
        role: `anchor` or `unknown`.
        located: whether the position may be relied on; always so for anchors.
        credible_radius_m: holds 90 % of the posterior [m]; 0 for anchors.
        second_mode: (x_m, y_m, weight) of another position that explains the data, too.
    """

    device: str
    x_m: float
    y_m: float
    z_m: float
    role: str
    located: bool
    credible_radius_m: float
    second_mode: tuple[float, float, float] | None

    @classmethod
    def anchor(cls, device: str, x_m: float, y_m: float, z_m: float) -> TwinDevice:
        """Return a device of declared position [m]."""
        return cls(device, float(x_m), float(y_m), float(z_m), "anchor", True, 0.0, None)


def read_device(content: dict[str, Any]) -> TwinDevice:
    """Return the device whose attributes JSON has held."""
    mode = content["second_mode"]
    return TwinDevice(**content | {"second_mode": None if mode is None else (*mode,)})


@dataclass(frozen=True)
class DeviceEstimate:
    """Estimated position of a device.

    Attributes:
        device: its index.
        x_m, y_m: mean over the heaviest mode of the posterior, or the position of least expected
            distance [m].
        z_m: height, as given [m].
        credible_radius_m: radius about the position that holds 90 % of the posterior, second modes
            included [m].
        second_mode: (x_m, y_m, weight) of another mode at least 20 m away with at least 5 % of the
            posterior; None: there is none.
        n_detected: measurements that were detected.
        n_links: all measurements.
        design_effect: number of links that count as one in the radius; 1: independent.
        located: False where the data do not determine the position: the device was never detected,
            or 90 % of the posterior cover half the map or more. Position and radius are then the
            best estimate from the links that were not detected, or NaN and infinity without any.
    """

    device: int
    x_m: float
    y_m: float
    z_m: float
    credible_radius_m: float
    second_mode: tuple[float, float, float] | None
    n_detected: int
    n_links: int
    design_effect: float
    located: bool
