"""The models whose residual is examined: kinds of twin that can be fitted to any of the links."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from typing_extensions import override

from radiotwin.channel.log_distance import LogDistance
from radiotwin.channel.segmented_log_distance import SegmentedLogDistance
from radiotwin.links import LinkData
from radiotwin.scene import Scene
from radiotwin.twin.fit_links import fit_known, fit_links, reliable_m
from radiotwin.twin.fit_paths import LOST_M, fit_paths, relocation_from
from radiotwin.twin.twin import Twin

MAX_RADIUS_M = 100.0  # of a device's circle by the law, for paths to be followed to locate it


class Base(ABC):
    """A kind of twin.

    Attributes:
        max_radius_m: devices with a wider circle say nothing about the channel [m].
    """

    name: ClassVar[str]
    max_radius_m: ClassVar[float] = np.inf

    @abstractmethod
    def fit(self, links: LinkData) -> Twin:
        """Fit to links.

        Raises:
            BadInput: they are too few or of no use.
        """

    def device_m(self, twin: Twin) -> np.ndarray:
        """Return positions (k, 3) of a twin's devices that may be relied on [m]; else NaN."""
        return reliable_m(twin.devices, self.max_radius_m)


class LogDistanceBase(Base):
    """One exponent and one intercept for all links (ITU-R P.1411: basic transmission loss)."""

    name = "log-distance"

    def __init__(self, scene: Scene | None, seed: int) -> None:
        self._scene, self._seed = scene, seed

    @override
    def fit(self, links: LinkData) -> Twin:
        if np.isfinite(links.device_m).all():
            return fit_known(links, LogDistance, self._seed)
        assert self._scene is not None  # without one, links of unlocated devices are left out
        return fit_links(links, self._scene, LogDistance, self._seed)


class TwinBase(Base):
    """The segmented law, and devices where it locates them."""

    name = "twin"
    max_radius_m = LOST_M

    def __init__(self, scene: Scene | None, seed: int) -> None:
        self.scene, self._seed = scene, seed
        # The base that follows paths asks for the same fits again.
        self._fitted: WeakKeyDictionary[LinkData, Twin] = WeakKeyDictionary()

    @override
    def fit(self, links: LinkData) -> Twin:
        if links not in self._fitted:
            if self.scene is None:
                self._fitted[links] = fit_known(links, SegmentedLogDistance, self._seed)
            else:
                self._fitted[links] = fit_links(links, self.scene, SegmentedLogDistance, self._seed)
        return self._fitted[links]


class RaytraceBase(Base):
    """Paths over the 3D map, and unknown devices where they explain the levels best.

    A device stays where the law has it if that is less sure than `MAX_RADIUS_M`: one that is surely
    elsewhere, because of what the map lacks, would be taken for an effect. All parts of the links
    are fitted in one process, as they ask for the same paths.
    """

    name = "raytrace"
    max_radius_m = LOST_M

    def __init__(self, law: TwinBase) -> None:
        assert law.scene is not None
        self._law, self._scene = law, law.scene
        self._relocation = relocation_from(law.scene, MAX_RADIUS_M)

    @override
    def fit(self, links: LinkData) -> Twin:
        return fit_paths(links, self._scene, self._law.fit(links), self._relocation)


BASES = (TwinBase.name, RaytraceBase.name, LogDistanceBase.name)


def make_bases(scene: Scene | None, seed: int) -> dict[str, Base]:
    """Return every kind of base that a scene allows, by name."""
    twin = TwinBase(scene, seed)
    bases: dict[str, Base] = {twin.name: twin, LogDistanceBase.name: LogDistanceBase(scene, seed)}
    if scene is not None:
        bases[RaytraceBase.name] = RaytraceBase(twin)
    return bases
