"""Read further models for a comparison, write its tables, and read them."""

import json
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
import pandas as pd
from pydantic import field_validator

from radiotwin.cells import write_csv
from radiotwin.compare import (
    CLASSES,
    DEFAULT_MODELS,
    Comparison,
    compare_models,
    published_models,
    split_flights,
)
from radiotwin.errors import BadInput
from radiotwin.execution import Executor
from radiotwin.files import atomic_path
from radiotwin.map_file import is_zarr
from radiotwin.measurements import Measurements
from radiotwin.radiomap import RadioMap
from radiotwin.records import Real, Record, Whole, read_record, validated
from radiotwin.scene import Scene
from radiotwin.twin import Twin

SCHEMA = "radiotwin.comparison/1"  # of compare.json


class ScoreRecord(Record):
    """Errors of a model on a class of links."""

    model: str
    against: str
    positions: Literal["estimated", "true"]
    links: Literal["all", "LoS", "NLoS"]
    n: Whole
    rmse_db: Real | None
    mae_db: Real | None
    bias_db: Real | None


class LocationRecord(Record):
    """Where a model located a device."""

    model: str
    device: str
    x_m: Real | None = None
    y_m: Real | None = None
    error_m: Real | None
    credible_radius_m: Real | None = None
    located: bool = False


class ComparisonRecord(Record):
    """Content of `compare.json`."""

    scores: list[ScoreRecord]
    locations: list[LocationRecord]

    @field_validator("scores")
    @classmethod
    def _complete(cls, scores: list[ScoreRecord]) -> list[ScoreRecord]:
        classes = Counter((each.model, each.against, each.positions) for each in scores)
        rows = {(each.model, each.against, each.positions, each.links) for each in scores}
        if len(rows) < len(scores) or any(count != len(CLASSES) for count in classes.values()):
            raise ValueError(f"not one row for each of {', '.join(CLASSES)} of a model")
        return scores


def compare_held_out(measurements: Measurements, scene: Scene, truth: RadioMap | None = None, *,
                     held_out: int = 1, raytrace: bool = False, also: Sequence[Path | str] = (),
                     seed: int = 0, executor: Executor | None = None) -> Comparison:
    """Compare all channel models on the last flights, which none of them is fitted to.

    Published laws that hold at the scene's frequency are among them, fitted to nothing.

    Args:
        measurements: of several flights.
        scene: where they were flown.
        truth: the whole map to judge on, too; None: there is none.
        held_out: number of the last flights.
        raytrace: compare the model `raytrace`, too; takes minutes.
        also: folders of twins and, with a truth, files of radio maps, to compare with the models.
        seed: of all fits.
        executor: where the models are fitted; None: in this process.

    Raises:
        BadInput: too few flights, or what `judge_also` and `compare_models` refuse.
    """
    train, test = split_flights(measurements, held_out)
    twins, maps = judge_also([Path(path) for path in also], truth, test.flights)
    models = (*DEFAULT_MODELS, *published_models(scene.config.radio.frequency_hz),
              *["raytrace"] * raytrace)
    return compare_models(train, test, scene, truth, seed=seed, models=models, twins=twins,
                          maps=maps, executor=executor)


def judge_also(paths: list[Path], truth: RadioMap | None, held_out: list[str],
               ) -> tuple[dict[str, Twin], dict[str, RadioMap]]:
    """Read twins and radio maps that are to be compared with the models.

    Warns where a twin was fitted to one of the held-out flights.

    Args:
        paths: folders of twins, and files of radio maps.
        truth: map of reference gains; None: there is none.
        held_out: names of the held-out flights.

    Returns:
        twins and maps, by their paths

    Raises:
        BadInput: neither a twin's folder nor a radio map, or a map without a truth.
    """
    twins, maps = {}, {}
    for path in paths:
        if path.is_dir() and not is_zarr(path):
            twins[str(path)] = Twin.load(path)
            fitted_to = set(twins[str(path)].provenance.get("flights", []))
            seen = sorted(fitted_to & set(held_out))
            if seen:
                warnings.warn(
                    f"{path} was fitted to {', '.join(seen[:4])}, which is held out here: its "
                    "error on held-out flights is too good", stacklevel=2)
        elif truth is None:
            raise BadInput(f"{path}: a radio map can only be judged on a whole map; give --truth, "
                           "too")
        else:
            maps[str(path)] = RadioMap.read(path)
    return twins, maps


def write_comparison(comparison: Comparison, scene: Scene, folder: Path | str) -> None:
    """Write the tables of a comparison.

    Args:
        comparison: result of `compare_models`.
        scene: whose name is recorded.
        folder: for `compare.json`, `scores.csv`, `locations.csv` and `predictions.csv.gz`; made if
            needed, files of these names are replaced.
    """
    folder = Path(folder)
    record = {"schema": SCHEMA, "scene": scene.config.name, "scores": _rows(comparison.scores),
              "locations": _rows(comparison.locations),
              "location_summary": _rows(comparison.location_summary())}
    with atomic_path(folder / "compare.json") as temporary:
        temporary.write_text(json.dumps(record, indent=1, allow_nan=False), encoding="utf-8")
    for name, table in (("scores.csv", comparison.scores), ("locations.csv", comparison.locations),
                        ("predictions.csv.gz", comparison.predictions)):
        with atomic_path(folder / name) as temporary:
            write_csv(table, temporary, "%.4f")


def read_comparison(path: Path) -> Comparison:
    """Read the tables of a comparison.

    Args:
        path: of a `compare.json`.

    Returns:
        scores and locations; twins and predictions are empty.

    Raises:
        BadInput: it cannot be read, it is of another version, or it is damaged.
    """
    record = read_record(path, "comparison (compare.json)")
    if record.get("schema") != SCHEMA:
        raise BadInput(f"{path}: schema is {repr(record.get('schema'))[:60]}, this version reads "
                       f"{SCHEMA!r}; make the run again")
    record = validated(ComparisonRecord, record, path, "run `radiotwin compare` again")
    scores = pd.DataFrame(record["scores"], columns=list(ScoreRecord.model_fields))
    locations = pd.DataFrame(record["locations"], columns=list(LocationRecord.model_fields))
    for table in (scores, locations):
        numbers = [name for name in table if name.endswith(("_db", "_m"))]
        table[numbers] = table[numbers].astype(float)
    return Comparison(scores, locations, {}, pd.DataFrame())


def _rows(table: pd.DataFrame) -> list[dict]:
    """Return the rows of a table for JSON; numbers that are not finite are null."""
    return [{key: None if isinstance(value, float) and not np.isfinite(value) else value
             for key, value in row.items()} for row in table.to_dict("records")]
