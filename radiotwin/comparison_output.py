"""What a comparison leaves in its folder: tables as CSV and JSON, and figures."""

import json
import warnings
from pathlib import Path

import numpy as np

from radiotwin.compare import Comparison
from radiotwin.errors import BadInput
from radiotwin.figures import draw_estimates, draw_maps, draw_scatter
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.twin import Twin

SCHEMA = "radiotwin.comparison/1"
SHOWN = ("log_distance", "segmented_nn")


def judge_also(paths: list[Path], truth: RadioMap | None, held_out: list[str],
               ) -> tuple[dict[str, Twin], dict[str, RadioMap]]:
    """Twins and radio maps that a user wants in the tables, by the names of their files.

    Warns where a twin has been fitted to one of the `held_out` flights already.

    Raises:
        BadInput: neither a twin's folder nor a radio map, or a map with no truth to hold it against.
    """
    twins, maps = {}, {}
    for path in paths:
        if path.is_dir():
            twins[str(path)] = Twin.load(path)
            seen = sorted(set(twins[str(path)].provenance.get("flights", [])) & set(held_out))
            if seen:
                warnings.warn(f"{path} was fitted to {', '.join(seen[:4])}, which is held out here: its error on "
                              "held-out flights is too good", stacklevel=2)
        elif truth is None:
            raise BadInput(f"{path}: a radio map can only be judged on a whole map; give --truth, too")
        else:
            maps[str(path)] = RadioMap.read(path)
    return twins, maps


def write_comparison(comparison: Comparison, scene: Scene, truth: RadioMap | None, folder: Path | str) -> None:
    """Write `compare.json`, `scores.csv`, `locations.csv`, `predictions.csv.gz` and the figures into a folder.

    Args:
        comparison: to write.
        scene: drawn under the figures.
        truth: with it, maps are drawn, too.
        folder: made if needed; files of the same names are replaced.
    """
    folder = Path(folder)
    record = {"schema": SCHEMA, "scene": scene.config.name, "scores": _records(comparison.scores),
              "locations": _records(comparison.locations), "location_summary": _records(comparison.location_summary())}
    with atomic_path(folder / "compare.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    for name, table in (("scores.csv", comparison.scores), ("locations.csv", comparison.locations),
                        ("predictions.csv.gz", comparison.predictions)):
        with atomic_path(folder / name) as temporary:
            table.to_csv(temporary, index=False, float_format="%.4f",
                         compression="gzip" if name.endswith(".gz") else None)
    draw_scatter(comparison, list(comparison.twins), folder / "scatter.png")
    if len(comparison.locations) and comparison.locations["error_m"].notna().all():
        draw_estimates(comparison, list(SHOWN), scene, folder / "estimates.png")
    if truth is not None:
        maps = {name: comparison.twins[name].radio_map(scene) for name in reversed(SHOWN)}
        draw_maps(truth, maps, scene, typical_device(truth, maps), folder / "maps.png")


def typical_device(truth: RadioMap, maps: dict[str, RadioMap]) -> str:
    """The device whose share of LoS is nearest to the mean of all that every map has: neither best nor worst case."""
    devices = [d for d in truth.devices if all(d in radio_map.devices for radio_map in maps.values())]
    los = np.array([truth.los[truth.devices.index(d)].mean() for d in devices])
    return devices[int(np.abs(los - los.mean()).argmin())]


def _records(table) -> list[dict]:
    return [{key: None if isinstance(value, float) and not np.isfinite(value) else value
             for key, value in row.items()} for row in table.to_dict("records")]
