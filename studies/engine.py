"""Accuracy and cost of the path engine (`radiotwin.propagation.paths`): `engine`.

Accuracy: links without line of sight above -128 dB, against Sionna RT with a million rays, as it is
released and as `radiotwin.trace.mended` mends it. Paths of both are
matched by kind and length, so that each difference is a path that one of them lacks or another
gain of the same path. Cost: set-up and time a link, the tracer's in the same run, and growth with
the number of faces.
"""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pandas as pd
import trimesh

from radiotwin import Scene
from radiotwin.io.files import scratch_folder
from radiotwin.propagation.paths import path_powers
from radiotwin.propagation.paths.candidates import CandidateSearch, candidate_search
from radiotwin.scene.build import BuildOptions, build_scene
from radiotwin.scene.citymap import CityMap
from radiotwin.trace.settings import SolverSettings
from radiotwin.trace.solver import PathGains
from studies.path_pairs import FoundPath, SionnaPaths, engine_paths, matched
from studies.runner import Study
from studies.tables import markdown, number, scene_folder

LIMIT_DB = -128.0
SAMPLES = 1_000_000
FREQUENCY_HZ = 2.4e9
FACES = (300, 1_000, 3_000, 10_000, 30_000, 100_000)
ONE_MATERIAL = {"metal": "itu_marble"}  # as of the walls: Munich's roofs diffract, too


def engine_cases(seed: int) -> dict[str, dict]:
    """Return settings of the accuracy and of the cost."""
    scenes = {"RBM": "rbm", "Munich": "sionna:munich"}
    accuracy = {f"accuracy: {name}": {"part": "accuracy", "city": scene, "links": 500}
                for name, scene in scenes.items()}
    accuracy["accuracy: Munich, roofs of the walls' material"] = {
        "part": "accuracy", "city": "sionna:munich", "links": 500, "one_material": True}
    cost = {f"cost: {name}": {"part": "cost", "city": scene, "devices": 5, "receivers": 500}
            for name, scene in scenes.items()}
    growth = {f"growth: {faces:,} faces": {"part": "growth", "faces": faces, "receivers": 500}
              for faces in FACES}
    return cost | growth | accuracy


def measure_engine(seed: int, settings: dict) -> dict:
    """Measure a `part` of the settings."""
    return PARTS[settings["part"]](seed, settings)


@contextmanager
def _scene(settings: dict) -> Iterator[Scene]:
    if not settings["city"].startswith("sionna:"):
        yield Scene.load(scene_folder(settings["city"]))
        return
    with scratch_folder() as folder:
        options = BuildOptions(devices=10, materials=ONE_MATERIAL if settings.get("one_material")
                               else None)
        build_scene(settings["city"], folder / "scene", options)
        yield Scene.load(folder / "scene")


def _draw(scene: Scene, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Return a draw of the lattice's points without line of sight to a device."""
    free_m = scene.lattice.positions_m[~scene.blocked.ravel()]

    def points_m(device_m: np.ndarray) -> np.ndarray:
        shuffled = free_m[rng.permutation(len(free_m))]
        return shuffled[~scene.city.line_of_sight(device_m[None], shuffled)]

    return points_m


def _gain_db(paths: list[FoundPath]) -> float:
    return 10 * np.log10(max(sum(path.gain for path in paths), 1e-30))


def measure_accuracy(seed: int, settings: dict) -> dict:
    """Compare links by released and by mended Sionna RT with the engine; return both results."""
    rng, out = np.random.default_rng(seed), {}
    with _scene(settings) as scene:
        draw = _draw(scene, rng)
        wanted = -(-settings["links"] // len(scene.device_m))
        sionna, chosen, theirs = SionnaPaths(scene, SAMPLES, "sionna"), [], []
        for device_m in scene.device_m:
            points_m, ends_m = draw(device_m)[:6 * wanted], np.empty((0, 3))
            found: list[list[FoundPath]] = []
            for start in range(0, len(points_m), 10):
                part_m = points_m[start:start + 10]
                traced = sionna.paths(device_m, part_m)
                strong = [row for row, paths in enumerate(traced) if _gain_db(paths) >= LIMIT_DB]
                ends_m = np.concatenate([ends_m, part_m[strong]])[:wanted]
                found += [traced[row] for row in strong]
                if len(ends_m) == wanted:
                    break
            chosen.append((device_m, ends_m))
            theirs += found[:wanted]
        mended = SionnaPaths(scene, SAMPLES, "reciprocal")
        better = [paths for ends in chosen for paths in mended.paths(*ends)]
        for name, truth in (("released", theirs), ("mended", better)):
            ours = [paths for ends in chosen for paths in engine_paths(scene, *ends)]
            out[name] = compare(ours, truth)
    return {"comparison": out}


def compare(ours: list[list[FoundPath]], theirs: list[list[FoundPath]]) -> dict[str, Any]:
    """Return differences [dB], ours minus theirs, also without the paths that one of them lacks."""
    whole, both, of_ours, of_theirs, same = [], [], [], [], []
    kinds: dict[str, list[float]] = {}
    for own, other in zip(ours, theirs):
        rows, others = matched(own, other)
        pair = [own[row] for row in rows], [other[row] for row in others]
        whole.append(_gain_db(own) - _gain_db(other))
        of_ours.append(_gain_db(pair[0]) - _gain_db(other))  # without those that they lack
        of_theirs.append(_gain_db(own) - _gain_db(pair[1]))  # without those that we lack
        if rows:
            both.append(_gain_db(pair[0]) - _gain_db(pair[1]))
        for one, two in zip(*pair):
            gap_db = 10 * np.log10(one.gain / two.gain)
            same.append(abs(gap_db))
            kinds.setdefault(one.kind, []).append(gap_db)
    error_db = np.array(whole)
    connected = np.isfinite(error_db) & (np.abs(error_db) < 100)
    error_db = error_db[connected]
    return {"links": len(whole), "without a path here": int(len(whole) - connected.sum()),
            "bias_db": error_db.mean(), "rms_db": _rms(error_db),
            "p90_db": np.quantile(np.abs(error_db), 0.9),
            "rms_without_paths_they_lack_db": _rms(np.array(of_ours)[connected]),
            "rms_without_paths_we_lack_db": _rms(np.array(of_theirs)[connected]),
            "rms_of_common_paths_db": _rms(np.array(both)),
            "bias_of_common_paths_db": np.mean(both),
            "paths": len(same), "same_path_p50_db": np.median(same),
            "same_path_p90_db": np.quantile(same, 0.9),
            "kinds": {kind: {"paths": len(gaps), "p50_db": np.median(gaps)}
                      for kind, gaps in sorted(kinds.items())}}


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values[np.abs(values) < 100] ** 2)))


def measure_cost(seed: int, settings: dict) -> dict:
    """Time set-up and links of the engine, and links of the tracer's default quality."""
    rng = np.random.default_rng(seed)
    with _scene(settings) as scene:
        lattice_m = scene.lattice.positions_m
        points_m = lattice_m[rng.choice(len(lattice_m), settings["receivers"], replace=False)]
        device_m = scene.device_m[:settings["devices"]]
        out = _time(scene.city, device_m, points_m)
        solver = PathGains(scene.xml_path, scene.config.radio.frequency_hz, SolverSettings())
        solver.gains(device_m[0], points_m[:100])  # compiles the kernels
        started = time.process_time()
        for one_m in device_m:
            solver.gains(one_m, points_m)
        traced_ms = 1e3 * (time.process_time() - started) / (len(device_m) * len(points_m))
    return out | {"traced_ms": traced_ms, "times_cheaper": traced_ms / out["link_ms"]}


def measure_growth(seed: int, settings: dict) -> dict:
    """Time a city of boxes, whose area grows with their number; receivers fly within 500 m."""
    rng = np.random.default_rng(seed)
    side = int(np.ceil(np.sqrt(settings["faces"] / 12)))
    boxes = []
    for column, row in np.ndindex(side, side):
        size_m = np.append(rng.uniform(20, 40, 2), rng.uniform(8, 40))
        box = trimesh.creation.box(extents=size_m)
        box.apply_translation([60 * (column - side / 2 + 0.5), 60 * (row - side / 2 + 0.5),
                               size_m[2] / 2])
        boxes.append(box)
    mesh: Any = trimesh.util.concatenate(boxes[:settings["faces"] // 12])
    reach_m = min(500.0, 30.0 * side)
    points_m = rng.uniform([-reach_m, -reach_m, 45], [reach_m, reach_m, 60],
                           (settings["receivers"], 3))
    street_m = 0.0 if side % 2 == 0 else 30.0  # the middle of the city is a crossing, or a building
    device_m = np.array([[60.0 * x + street_m, 60.0 * y + street_m, 1.5]
                         for x, y in ((0, 0), (1, 0), (0, -1))])
    return _time(CityMap(mesh.vertices, mesh.faces), device_m, points_m)


def _time(city: CityMap, device_m: np.ndarray, points_m: np.ndarray) -> dict[str, float]:
    """Return seconds of processor time: set-up, then links of devices that are new to the city."""
    small = CityMap(*_first_faces(city))
    path_powers(small, device_m[0], points_m[:10], FREQUENCY_HZ)  # compiles, or loads it
    started = time.process_time()
    CandidateSearch(city, 4)
    setup_s = time.process_time() - started
    candidate_search(city, 4)
    started = time.process_time()
    for each_m in device_m:
        path_powers(city, each_m, points_m, FREQUENCY_HZ)
    return {"faces": len(city.faces), "setup_s": setup_s,
            "link_ms": 1e3 * (time.process_time() - started) / (len(device_m) * len(points_m))}


def _first_faces(city: CityMap) -> tuple[np.ndarray, np.ndarray]:
    return city.vertices, city.faces[:200]


PARTS = {"accuracy": measure_accuracy, "cost": measure_cost, "growth": measure_growth}


def engine_table(rows: pd.DataFrame) -> str:
    """Return the tables of accuracy and cost."""
    accuracy, cost = [], []
    for _, row in rows.iterrows():
        name = row["name"].split(": ", 1)[1]
        if row["name"].startswith("accuracy"):
            for which, found in row["comparison"].items():
                accuracy.append([name, which, *(
                    number(found[key], 2) for key in (
                        "bias_db", "rms_db", "p90_db", "rms_without_paths_they_lack_db",
                        "rms_without_paths_we_lack_db", "rms_of_common_paths_db",
                        "same_path_p90_db")), f"{found['links']}"])
        else:
            cost.append([name, f"{row['faces']:,.0f}", number(row["setup_s"], 2),
                         number(row["link_ms"], 2), number(row.get("traced_ms"), 1),
                         number(row.get("times_cheaper"), 1)])
    heads = ["scene", "Sionna RT", "bias [dB]", "RMS [dB]", "90 % within [dB]",
             "RMS without paths that Sionna lacks", "RMS without paths that the engine lacks",
             "RMS of common paths", "90 % of the same paths within [dB]", "links"]
    accurate = [markdown(heads, accuracy, "Accuracy", " against Sionna RT with a million rays.")]
    return "\n\n".join([
        *(accurate if accuracy else []),
        markdown(["city", "faces", "set-up [s]", "a link [ms]", "traced [ms]", "times cheaper"],
                 sorted(cost, key=lambda line: float(line[1].replace(",", ""))), "Cost",
                 " on one core, in processor time; traced with the default quality.")])


STUDIES = {"engine": Study("How accurate is the path engine, and what does it cost?",
                           measure_engine, engine_cases, engine_table, seeds=1)}
