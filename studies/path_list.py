"""Own paths against Sionna RT's, one by one: `paths`.

Links of a scene's lattice are solved by both. A path is the same one in both if it has the same
kinds of interactions at the same points, to a metre.
"""

from typing import Any

import numpy as np
import pandas as pd

from radiotwin import Scene, SolverSettings, list_paths
from radiotwin.trace.mended import mended
from radiotwin.trace.settings import DIFFRACTION_PROBABILITY, TABLE_SIZE
from radiotwin.trace.solver import candidate_search, import_sionna, load_city
from studies.runner import Study
from studies.tables import markdown, scene_folder

SAME_POINT_M = 1.0
MIN_GAIN_DB = -135.0  # weaker paths are not compared: they add nothing to a link
SIONNA_DIFFRACTION = 8  # flag of `sionna.rt.constants.InteractionType`


def path_cases(seed: int) -> dict[str, dict]:
    """Return scenes and numbers of links."""
    return {"rbm": {"scene": "rbm", "receivers": 20, "samples": 1_000_000}}


def compare_paths(seed: int, settings: dict) -> dict:
    """Match the paths of both, and compare what they say of path and link.

    Returns:
        Counts of paths, the share of Sionna's power that is matched, differences of the matched
        paths (own minus Sionna's), and of the links' delay spreads.
    """
    scene = Scene.load(scene_folder(settings["scene"]))
    rng, lattice_m = np.random.default_rng(seed), scene.lattice.positions_m[~scene.blocked.ravel()]
    points_m = lattice_m[rng.choice(len(lattice_m), settings["receivers"], replace=False)]
    own = _own_paths(list_paths(scene, points_m))
    theirs = _sionna_paths(scene, points_m, settings["samples"], seed)
    own, theirs = (each[each["gain_db"] > MIN_GAIN_DB].reset_index(drop=True)
                   for each in (own, theirs))
    mine, other = _matches(own, theirs)
    a, b = own.iloc[mine], theirs.iloc[other]
    row: dict[str, Any] = {"links": int(theirs["link"].nunique()), "own_paths": len(own),
                           "sionna_paths": len(theirs), "matched": len(mine),
                           "matched_power": _power(b).sum() / _power(theirs).sum()}
    delay_ns = 1e9 * np.abs(a["delay_s"].to_numpy() - b["delay_s"].to_numpy())
    row["delay_p99_ns"] = np.quantile(delay_ns, 0.99)
    for end in ("departure", "arrival"):
        cosine = np.einsum("ij,ij->i", np.stack(a[end]), np.stack(b[end]))
        row[f"{end}_p99_deg"] = np.quantile(np.degrees(np.arccos(np.clip(cosine, -1, 1))), 0.99)
    error_db = a["gain_db"].to_numpy() - b["gain_db"].to_numpy()
    over_edge = np.array(["D" in kinds for kinds in b["kinds"]])
    for name, part in (("reflected", error_db[~over_edge]), ("diffracted", error_db[over_edge])):
        row |= {f"{name}_paths": len(part), f"{name}_median_db": np.median(part),
                f"{name}_p90_db": np.quantile(np.abs(part), 0.9),
                f"{name}_rms_db": np.sqrt(np.mean(part**2))}
    spread_ns = pd.concat([_delay_spread_ns(own), _delay_spread_ns(theirs)], axis=1).dropna()
    row["delay_spread_correlation"] = spread_ns.corr().iloc[0, 1]
    row["delay_spread_median_ns"] = spread_ns.iloc[:, 1].median()
    row["delay_spread_error_ns"] = (spread_ns.iloc[:, 0] - spread_ns.iloc[:, 1]).abs().median()
    return row


def _power(paths: pd.DataFrame) -> np.ndarray:
    return 10 ** (paths["gain_db"].to_numpy() / 10)


def _delay_spread_ns(paths: pd.DataFrame) -> pd.Series:
    """Return the RMS delay spread of each link [ns]."""
    def of_link(part: pd.DataFrame) -> float:
        power, delay_ns = _power(part), 1e9 * part["delay_s"].to_numpy()
        return float(np.sqrt(np.average((delay_ns - np.average(delay_ns, weights=power)) ** 2,
                                        weights=power)))

    return paths.groupby("link")[["gain_db", "delay_s"]].apply(of_link)


def _own_paths(listed: Any) -> pd.DataFrame:
    kinds = listed["interactions"].to_numpy()
    points_m = listed["interaction_m"].to_numpy()
    rays = {}
    for end in ("departure", "arrival"):
        azimuth, elevation = (np.radians(listed[f"{end}_{angle}_deg"].to_numpy())
                              for angle in ("azimuth", "elevation"))
        rays[end] = list(np.column_stack([np.sin(azimuth) * np.cos(elevation),
                                          np.cos(azimuth) * np.cos(elevation), np.sin(elevation)]))
    return pd.DataFrame({
        "link": listed["link_of_path"].to_numpy(), "gain_db": listed["path_gain_db"].to_numpy(),
        "delay_s": listed["delay_s"].to_numpy(), **rays,
        "kinds": ["".join("RD"[kind - 1] for kind in each if kind) for each in kinds],
        "points_m": [each[:np.count_nonzero(kind)] for each, kind in zip(points_m, kinds)]})


def _sionna_paths(scene: Scene, points_m: np.ndarray, samples: int, seed: int) -> pd.DataFrame:
    """Return the paths of all links, devices one after another as in `list_paths`."""
    settings = SolverSettings(samples_per_src=samples, batch_receivers=10)
    rt = import_sionna()
    city = load_city(scene.xml_path, scene.config.radio.frequency_hz)
    solver = rt.PathSolver(deterministic=True)
    city.add(rt.Transmitter("device", position=[0.0, 0.0, 0.0]))
    ends = [rt.Receiver(f"r{i}", position=[0.0, 0.0, 0.0]) for i in range(settings.batch_receivers)]
    for end in ends:
        city.add(end)
    rows = []
    for device, device_m in enumerate(scene.device_m):
        city.transmitters["device"].position = device_m.tolist()
        for first in range(0, len(points_m), len(ends)):
            for end, point_m in zip(ends, points_m[first:first + len(ends)]):
                end.position = point_m.tolist()
            with candidate_search(TABLE_SIZE, DIFFRACTION_PROBABILITY), mended("reciprocal"):
                paths = solver(city, max_depth=settings.max_depth, samples_per_src=samples,
                               max_num_paths_per_src=settings.max_num_paths_per_src,
                               refraction=False, diffraction=True, seed=seed + 1)
            for i in range(min(len(ends), len(points_m) - first)):
                rows += _of_link(paths, len(ends), i, device * len(points_m) + first + i)
    return pd.DataFrame(rows)


def _of_link(paths: Any, receivers: int, receiver: int, link: int) -> list[dict]:
    """Return the paths of one of the receivers of a call."""
    def column(values: Any, *shape: int) -> np.ndarray:
        return np.array(values, dtype=float).reshape(*shape[:1], receivers, -1, *shape[1:])

    amplitude = (column(paths.a[0]) + 1j * column(paths.a[1]))[receiver]
    delay_s = column(paths.tau)[receiver]
    depth = np.array(paths.interactions).shape[0]
    kinds = column(paths.interactions, depth)[:, receiver].T.astype(int)
    points_m = column(paths.vertices, depth, 3)[:, receiver].transpose(1, 0, 2)
    rays = {}
    for end, letter in (("departure", "t"), ("arrival", "r")):
        zenith, azimuth = (column(getattr(paths, f"{angle}_{letter}"))[receiver]
                           for angle in ("theta", "phi"))
        rays[end] = np.column_stack([np.sin(zenith) * np.cos(azimuth),
                                     np.sin(zenith) * np.sin(azimuth), np.cos(zenith)])
    found, seen = [], set()
    for path in np.flatnonzero(np.abs(amplitude) > 0):
        used = kinds[path] > 0
        way = tuple(kinds[path]), round(float(1e11 * delay_s[path]))
        if not used.any() and way in seen:  # the direct path, many times over
            continue
        seen.add(way)
        found.append({"link": link, "gain_db": 20 * np.log10(np.abs(amplitude[path])),
                      "delay_s": delay_s[path],
                      **{end: ray[path] for end, ray in rays.items()},
                      "kinds": "".join("D" if kind == SIONNA_DIFFRACTION else "R"
                                       for kind in kinds[path][used]),
                      "points_m": points_m[path][used]})
    return found


def _matches(own: pd.DataFrame, theirs: pd.DataFrame) -> tuple[list[int], list[int]]:
    """Return the rows of paths that both have, each used once."""
    mine, other = [], []
    groups = own.groupby(["link", "kinds"]).indices
    for key, rows in theirs.groupby(["link", "kinds"]).indices.items():
        free = list(groups.get(key, []))
        for row in rows:
            apart_m = [np.abs(own["points_m"][each] - theirs["points_m"][row]).max(initial=0.0)
                       for each in free]
            if free and min(apart_m) < SAME_POINT_M:
                mine.append(free.pop(int(np.argmin(apart_m))))
                other.append(row)
    return mine, other


def path_table(rows: pd.DataFrame) -> str:
    """Return matched paths and their differences."""
    heads = ["scene", "links", "paths of Sionna RT", "in both", "of its power", "delay, 99 % [ns]",
             "departure, arrival, 99 % [°]", "reflected: median, 90 %, RMS [dB]",
             "diffracted: median, 90 %, RMS [dB]", "delay spread: correlation",
             "its median, and that of the difference [ns]"]
    return markdown(heads, [[
        row["name"], *(str(row[count]) for count in ("links", "sionna_paths", "matched")),
        f"{100 * row['matched_power']:.1f} %", f"{row['delay_p99_ns']:.4f}",
        f"{row['departure_p99_deg']:.3f}, {row['arrival_p99_deg']:.3f}",
        *(", ".join(f"{row[f'{kind}_{what}_db']:.2f}" for what in ("median", "p90", "rms"))
          for kind in ("reflected", "diffracted")),
        f"{row['delay_spread_correlation']:.3f}",
        f"{row['delay_spread_median_ns']:.0f}, {row['delay_spread_error_ns']:.1f}"]
        for _, row in rows.iterrows()])


STUDIES = {"paths": Study("Are the listed paths those of the ray tracer?", compare_paths,
                          path_cases, path_table, seeds=1)}
