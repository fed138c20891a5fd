"""Compare channel models on held-out flights and on a truth map: `compare_models`."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from radiotwin.errors import BadInput
from radiotwin.inference.gaussian import mean_if_detected
from radiotwin.links.declared import antenna_of_uavs, radios_of
from radiotwin.links.measurements import Measurements
from radiotwin.maps.radiomap import RadioMap
from radiotwin.propagation.laws import channel_named
from radiotwin.propagation.laws.published import MAX_FACTOR, PublishedLaw
from radiotwin.runtime.execution import Executor, Job, Resources
from radiotwin.runtime.pieces import with_pieces
from radiotwin.scene import Scene
from radiotwin.scene.footing import moved_outdoors
from radiotwin.twin import Twin, fit_twin

DEFAULT_MODELS = ("log_distance", "segmented_log_distance", "segmented_nn", "kriging")
# Published laws that `radiotwin compare` adds: they are not fitted, so only localisation takes time
PUBLISHED_MODELS = ("tr36777_uma", "tr36777_umi", "al_hourani_urban", "p1411", "cost231_wi")
WORKER_BYTES = 3 * 2**30  # memory of a process that fits a model
CLASSES = ("all", "LoS", "NLoS")  # classes of links in the tables
LABELS = ("flight", "receiver", "device")  # columns of `Comparison.predictions` that label links


@dataclass(frozen=True, eq=False)
class Comparison:
    """Errors of channel models on one data set.

    Attributes:
        scores: one row for each (model, against, positions, links): n, rmse_db, mae_db, bias_db.
            `against` is `held-out flights` or `whole map`; `positions` is `estimated` (by the twin)
            or `true` (errors of the channel only); `links` is all, LoS or NLoS at the true
            positions.
        locations: one row for each (model, unknown device): error_m, credible_radius_m, located.
        twins: fitted twins by model.
        predictions: held-out links with `measured_db`, `los` (1, 0, or NaN if the true position is
            unknown) and a column of predictions for each model.
    """

    scores: pd.DataFrame
    locations: pd.DataFrame
    twins: dict[str, Twin]
    predictions: pd.DataFrame

    def tables(self) -> list[tuple[str, dict[str, str], list[list]]]:
        """Return the tables to print: (title, heading -> alignment, rows); scores first."""
        tables: list[tuple[str, dict[str, str], list[list]]] = []
        estimated = self.scores[self.scores["positions"] == "estimated"]
        for against, part in estimated.groupby("against", sort=False):
            columns = {"model": "left"} | dict.fromkeys(("RMSE", "MAE", "bias"), "right")
            rows = []
            for model, of_model in part.groupby("model", sort=False):
                of_class = of_model.set_index("links")
                rows.append([self._label(model), *(
                    "/".join(_short(of_class.loc[links, f"{measure}_db"]) for links in CLASSES)
                    for measure in ("rmse", "mae", "bias"))])
            links = part.groupby("links")["n"].max()
            counts = "/".join(str(links[name]) for name in CLASSES)
            tables.append((f"Error on {against} [dB]: all/LoS/NLoS of {counts} links", columns,
                           rows))
        summary = self.location_summary()
        if len(summary):
            tables.append(("Error of the unknown devices' positions [m]",
                           {"model": "left"} | dict.fromkeys(
                               ("located", "median", "90 %", "worst"), "right"),
                           [[self._label(row.model), int(row.devices), row.median_m, row.p90_m,
                             row.worst_m]
                            for row in summary.itertuples()]))
        return tables

    def _label(self, model: str) -> str:
        """Return a model's name, followed by "(no fit)" for a published law."""
        twin = self.twins.get(model)
        published = twin is not None and isinstance(twin.channel, PublishedLaw)
        return f"{model} (no fit)" if published else model

    def location_summary(self) -> pd.DataFrame:
        """Return median, 90th percentile and largest position error of each model [m].

        `devices` is the number of devices with an estimated, even if vague, and a true position.
        """
        def summary(errors: pd.Series) -> pd.Series:
            return pd.Series({"devices": errors.count(), "median_m": errors.median(),
                              "p90_m": errors.quantile(0.9), "worst_m": errors.max()})
        if self.locations.empty or self.locations["error_m"].isna().all():
            return pd.DataFrame(columns=["model", "devices", "median_m", "p90_m", "worst_m"])
        errors_m = self.locations.groupby("model", sort=False)["error_m"]
        return errors_m.apply(summary).unstack().reset_index()


def _short(value: float) -> str:
    """Format an error for a table; a dash for NaN."""
    return "–" if np.isnan(value) else f"{value:.2f}"


def published_models(frequency_hz: float) -> tuple[str, ...]:
    """Return the `PUBLISHED_MODELS` for use at a frequency [Hz] in, or near, their range."""
    def holds(name: str) -> bool:
        law = channel_named(name)
        assert issubclass(law, PublishedLaw)
        low_hz, high_hz = law.frequency_range_hz
        return low_hz / MAX_FACTOR <= frequency_hz <= high_hz * MAX_FACTOR

    return tuple(filter(holds, PUBLISHED_MODELS))


def split_flights(measurements: Measurements, held_out: int = 1
                  ) -> tuple[Measurements, Measurements]:
    """Split measurements into those to train on and those of the last, held-out flights.

    Args:
        measurements: measurements of two flights or more.
        held_out: number of held-out flights.

    Raises:
        BadInput: `held_out` is below 1, or no flight would be left to learn from.
    """
    flights = measurements.flights
    if held_out < 1:
        raise BadInput(f"held-out flights = {held_out}: at least 1 is needed to compare on")
    if len(flights) <= held_out:
        some = "1 flight" if len(flights) == 1 else f"{len(flights)} flights"
        raise BadInput(
            f"{some} in the measurements ({', '.join(flights[:4])}), {held_out} to be held out: at "
            f"least {held_out + 1} are needed, so that models are judged on a flight that they "
            "were not fitted to; survey more flights, or hold out fewer")
    test = measurements.table["flight"].isin(flights[-held_out:]).to_numpy()
    return measurements.select(~test), measurements.select(test)


def compare_models(train: Measurements, test: Measurements, scene: Scene,
                   truth: RadioMap | None = None, *, seed: int = 0,
                   models: tuple[str, ...] = DEFAULT_MODELS,
                   twins: dict[str, Twin] | None = None,
                   maps: dict[str, RadioMap] | None = None,
                   executor: Executor | None = None) -> Comparison:
    """Fit every model to the same training links, and score all on the same held-out links.

    Args:
        train: training links.
        test: held-out links.
        scene: scene of both; true positions of its devices are used for scores only.
        truth: truth map for scores; None: none.
        seed: of all fits.
        models: names of channel models, see `fit_twin`.
        twins: already fitted twins to score, too, by name in the tables.
        maps: radio maps to score on the truth map, by name in the tables.
        executor: runs the fits; None: this process.

    Raises:
        BadInput: nothing was detected on held-out flights, the truth is of another scene, a twin or
            map has the name of a model, or an error of `fit_twin`.
    """
    _check(test, scene, truth, twins or {})
    for name in (*(twins or {}), *(maps or {})):
        if name in {*models, *LABELS, "measured_db", "los"}:
            raise BadInput(f"{name} is the name of a model or of a column in the tables, too; "
                           "rename it, or give it from another folder")
    for twin in (twins or {}).values():
        twin.require_map(scene)  # before the fits, which take long
    job = Job("comparing models", with_pieces(partial(fit_twin, train, scene, seed=seed)),
              Resources(WORKER_BYTES, False))
    fitted = dict(zip(models, (executor or Executor()).run(job, models), strict=True))
    fitted |= twins or {}
    true_m = true_positions(scene, train)
    los = _los(scene, true_m, test)
    predictions = test.table[[*LABELS]].assign(measured_db=test.level_db, los=los)
    scores, locations = [], []
    for model, twin in fitted.items():
        predictions[model] = predict(twin, scene, test)
        scores += _scores(model, "held-out flights", "estimated", test.level_db,
                          predictions[model].to_numpy(), los)
        if truth is not None:
            scores += score_map(model, twin.radio_map(scene), truth)
        if all(device.device in true_m for device in twin.devices):
            ideal = _moved(twin, true_m)
            scores += _scores(model, "held-out flights", "true", test.level_db,
                              predict(ideal, scene, test), los)
            if truth is not None:
                scores += score_map(model, ideal.radio_map(scene), truth, positions="true")
        locations += _location_rows(model, twin, true_m)
    for name, candidate in (maps or {}).items():
        assert truth is not None  # maps are scored on the truth map only
        scores += score_map(name, candidate, truth)
    return Comparison(pd.DataFrame(scores), pd.DataFrame(locations), fitted, predictions)


def _check(test: Measurements, scene: Scene, truth: RadioMap | None,
           twins: dict[str, Twin]) -> None:
    """Raise BadInput if held-out links, truth or twins cannot be compared."""
    if not np.isfinite(test.level_db).any():
        raise BadInput("nothing was detected on the held-out flights "
                       f"({', '.join(test.flights[:4])}), so no error can be computed; hold out "
                       "other flights")
    if truth is not None:
        truth.require_made_for(scene)
    for name, twin in twins.items():
        if twin.level != test.level_column:
            raise BadInput(f"{name} predicts {twin.level}, the measurements hold "
                           f"{test.level_column}; they cannot be compared")


def true_positions(scene: Scene,
                   measurements: Measurements) -> dict[str, tuple[float, float, float]]:
    """Return the true positions (x, y, z) [m] of measured devices by name, as far as declared.

    Those of the measurements' anchors have precedence over those of the scene.
    """
    known = {d.device: (d.x_m, d.y_m, d.z_m) for d in scene.config.devices}
    known |= {row.device: (row.x_m, row.y_m, row.z_m) for row in measurements.devices.itertuples()
              if row.role == "anchor"}
    return {name: known[name] for name in measurements.devices["device"] if name in known}


def predict(twin: Twin, scene: Scene, measurements: Measurements) -> np.ndarray:
    """Predict the levels (n,) [dB] of measured links, given that they are detected.

    Errors can be computed for detected links only, and near the limit of detection only the
    strongest are detected. The unconditional mean would be biased, most for the model with the
    largest standard deviation. NaN for devices that the twin does not know, or could not locate.
    """
    row_of = {device.device: row for row, device in enumerate(twin.devices)
              if np.isfinite([device.x_m, device.y_m]).all()}
    row_of_device = np.array([row_of.get(name, -1) for name in measurements.devices["device"]])
    row = row_of_device[measurements.device_index]
    predicted_db = np.full(len(row), np.nan)
    if (row >= 0).any():
        links = twin.links(measurements.receiver_m[row >= 0], row[row >= 0], scene)
        radios = radios_of(measurements.devices, measurements.patterns, scene)
        declared = twin.declared.with_radios(
            {row: radio for row, radio in zip(row_of_device, radios) if row >= 0})
        if antenna_of_uavs(scene, list(measurements.table["receiver"]))[0] is None:
            declared = replace(declared, receiver_antenna=None)
        links = links.with_ends(declared=declared)
        predicted_db[row >= 0] = twin.predict(links).reading_db
    return predicted_db


def _moved(twin: Twin, position_m: dict[str, tuple[float, float, float]]) -> Twin:
    """Return the twin with its devices at other positions."""
    devices = [
        replace(device, **dict[str, Any](zip(("x_m", "y_m", "z_m"), position_m[device.device])))
        for device in twin.devices]
    return replace(twin, devices=devices)


def score_map(name: str, candidate: RadioMap, truth: RadioMap,
              positions: str = "estimated") -> list[dict]:
    """Score a radio map against a truth map; return rows of `Comparison.scores`.

    Args:
        name: name of the map in the rows.
        candidate: map to score.
        truth: truth map on the same lattice.
        positions: `estimated` or `true`, in the rows.

    Raises:
        BadInput: the maps have no device in common, or different lattices.
    """
    common = [device for device in truth.devices if device in candidate.devices]
    if not common or candidate.gain_db.shape[1:] != truth.gain_db.shape[1:] or \
            not np.allclose(candidate.lattice.positions_m, truth.lattice.positions_m):
        raise BadInput(
            f"map {name} cannot be compared with the truth: devices {candidate.devices} on a "
            f"lattice of {candidate.gain_db.shape[1:]} positions, the truth has {truth.devices} on "
            f"{truth.gain_db.shape[1:]}; make both for the same scene")
    rows, truth_rows = ([m.devices.index(device) for device in common] for m in (candidate, truth))
    return _scores(name, "whole map", positions, truth.gain_db[truth_rows].astype(float).ravel(),
                   comparable_db(candidate, truth)[rows].ravel(), truth.los[truth_rows].ravel())


def comparable_db(candidate: RadioMap, truth: RadioMap) -> np.ndarray:
    """Return a map's gains (device, z, y, x) [dB] for comparison with those of a truth map.

    If only the map has a standard deviation, they are means given detection.
    """
    gain_db = candidate.gain_db.astype(float)
    if "sigma_db" not in candidate.dataset or "sigma_db" in truth.dataset:
        return gain_db
    return mean_if_detected(gain_db, candidate.dataset["sigma_db"].values.astype(float),
                            truth.dataset.attrs.get("gain_limit_db", -np.inf))


def _los(scene: Scene, true_m: dict, links: Measurements) -> np.ndarray:
    """Return the line of sight (n,) from true positions, moved outdoors: 1, 0; NaN: unknown."""
    position_m = np.array([true_m.get(name, (np.nan,) * 3) for name in links.devices["device"]])
    placed = np.isfinite(position_m).all(axis=1)
    position_m[placed] = moved_outdoors(scene.city, position_m[placed])  # as in the twins
    device_m = position_m[links.device_index]
    los = np.full(len(device_m), np.nan)
    known = np.isfinite(device_m).all(axis=1)
    los[known] = scene.city.line_of_sight(device_m[known], links.receiver_m[known])
    return los


def _scores(model: str, against: str, positions: str, measured_db: np.ndarray,
            predicted_db: np.ndarray, los: np.ndarray) -> list[dict]:
    """Return errors [dB] of detected and predicted links: all, LoS (1), NLoS (0); NaN: no link."""
    rows = []
    usable = np.isfinite(measured_db) & np.isfinite(predicted_db)
    for links, mask in zip(CLASSES, (usable, usable & (los == 1), usable & (los == 0))):
        error_db = predicted_db[mask] - measured_db[mask]
        rmse_db = mae_db = bias_db = np.nan
        if len(error_db):
            rmse_db, mae_db = np.sqrt(np.mean(error_db**2)), np.mean(np.abs(error_db))
            bias_db = np.mean(error_db)
        rows.append({"model": model, "against": against, "positions": positions, "links": links,
                     "n": int(mask.sum()), "rmse_db": float(rmse_db), "mae_db": float(mae_db),
                     "bias_db": float(bias_db)})
    return rows


def _location_rows(model: str, twin: Twin, true_m: dict) -> list[dict]:
    """Return rows of unknown devices: horizontal error (NaN: no true position), 90 % radius [m]."""
    rows = []
    for device in twin.devices:
        if device.role == "unknown":
            x_m, y_m, _ = true_m.get(device.device, (np.nan,) * 3)
            rows.append({
                "model": model, "device": device.device, "x_m": device.x_m, "y_m": device.y_m,
                "error_m": float(np.hypot(device.x_m - x_m, device.y_m - y_m)),
                "credible_radius_m": device.credible_radius_m, "located": device.located})
    return rows
