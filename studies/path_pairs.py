"""The same links by Sionna RT and by the engine, path by path."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.constants import speed_of_light

from radiotwin.propagation.paths.candidates import candidate_search
from radiotwin.propagation.paths.images import PathBuffer
from radiotwin.propagation.paths.interactions import city_slabs
from radiotwin.propagation.paths.powers import PATH_CHUNK, clear_paths_gains
from radiotwin.scene import Scene
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import Antennas, PathGains

DEPTH = 4
SAME_M = 0.02  # [m], greatest difference of the lengths of one path; Sionna RT's are single
KINDS = {1: "R", 8: "D"}  # of Sionna RT's interactions


@dataclass(frozen=True)
class FoundPath:
    """One path of a link.

    Attributes:
        kind: interactions in their order: R reflection, D diffraction.
        length_m: of the whole path [m].
        gain: of its power, linear.
    """

    kind: str
    length_m: float
    gain: float


def engine_paths(scene: Scene, device_m: np.ndarray, receiver_m: np.ndarray
                 ) -> list[list[FoundPath]]:
    """Return the engine's paths from one device to receivers (n, 3) without line of sight."""
    city, frequency_hz = scene.city, scene.config.radio.frequency_hz
    search, buffer = candidate_search(city, DEPTH), PathBuffer.allocate(PATH_CHUNK)
    candidates, slabs = search.candidates(device_m), city_slabs(city, frequency_hz)
    out: list[list[FoundPath]] = [[] for _ in receiver_m]
    for clear, gain in clear_paths_gains(
            city, search, candidates, device_m, receiver_m, buffer,
            2 * np.pi * frequency_hz / speed_of_light, slabs):
        for path, power in zip(clear, gain):
            row, count = buffer.candidate[path], buffer.count[path]
            before, after = ((facets[row] >= 0).sum() for facets in (candidates.before,
                                                                     candidates.after))
            legs_m = np.diff(buffer.points_m[path, :count], axis=0)
            kind = "R" * before + ("D" + "R" * after if candidates.edge[row] >= 0 else "")
            out[buffer.receiver[path]].append(FoundPath(
                kind, float(np.linalg.norm(legs_m, axis=1).sum()), float(power)))
    return out


class SionnaPaths:
    """Paths by Sionna RT, each once.

    Args:
        scene: that the links are in.
        samples: rays from each device.
        diffraction: as in `SolverSettings`.
    """

    def __init__(self, scene: Scene, samples: int, diffraction: Any) -> None:
        self._settings = SolverSettings(samples_per_src=samples, max_depth=DEPTH,
                                        batch_receivers=10, diffraction=diffraction)
        self._solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, self._settings)
        self._found: list[list[FoundPath]] = []
        self._combine = self._solver._combine
        self._solver._combine = self._keep  # type: ignore[method-assign]

    def paths(self, device_m: np.ndarray, receiver_m: np.ndarray) -> list[list[FoundPath]]:
        """Return the paths from one device to receivers (n, 3)."""
        out: list[list[FoundPath]] = []
        for part in self._solver.batches(len(receiver_m)):
            self._solver.solve(device_m, receiver_m[part])
            out += self._found[:len(receiver_m[part])]
        return out

    def _keep(self, paths: Any, antennas: Antennas) -> tuple[np.ndarray, np.ndarray]:
        rows = self._settings.batch_receivers
        real, imaginary = (np.array(part, dtype=float).reshape(rows, -1) for part in paths.a)
        power = real**2 + imaginary**2
        length_m = speed_of_light * np.array(paths.tau, dtype=float).reshape(rows, -1)
        self._found = [[] for _ in range(rows)]
        if not power.size:
            return self._combine(paths, antennas)
        kinds = np.array(paths.interactions).reshape(-1, *power.shape)
        points_m = np.array(paths.vertices).reshape(*kinds.shape, 3)
        known = set()
        for row, path in zip(*np.nonzero(power)):
            used = kinds[:, row, path] != 0
            place = np.round(points_m[used, row, path], 1).tobytes()
            if (row, place) not in known:  # some come out more than once
                known.add((row, place))
                self._found[row].append(FoundPath(
                    "".join(KINDS[int(kind)] for kind in kinds[used, row, path]),
                    float(length_m[row, path]), float(power[row, path])))
        return self._combine(paths, antennas)


def matched(ours: list[FoundPath], theirs: list[FoundPath]) -> tuple[list[int], list[int]]:
    """Return the rows of paths that both have: of one kind and one length."""
    of_ours: list[int] = []
    of_theirs: list[int] = []
    for row, path in enumerate(theirs):
        apart = [(abs(own.length_m - path.length_m), at) for at, own in enumerate(ours)
                 if own.kind == path.kind and at not in of_ours]
        if apart and min(apart)[0] < SAME_M:
            of_ours.append(min(apart)[1])
            of_theirs.append(row)
    return of_ours, of_theirs
