"""Channel models held against each other: on flights that none has seen, and on the whole truth map."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from radiotwin.channel import MODELS, make_links
from radiotwin.channel.likelihood import mean_if_detected
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.progress import progress
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.twin import Twin, fit_twin

CLASSES = ("all", "LoS", "NLoS")


@dataclass(frozen=True, eq=False)
class Comparison:
    """What the models make of one data set.

    Attributes:
        scores: one row for each (model, against, positions, links): n, rmse_db, mae_db, bias_db.
            `against` is `held-out flights` or `whole map`; `positions` is `estimated` (the twin as it is) or `true`
            (the channel alone); `links` is all, LoS or NLoS by the true positions where they are known.
        locations: one row for each (model, unknown device): error_m, credible_radius_m, located.
        twins: the fitted twins by model.
        predictions: held-out links with `measured_db`, `los` and a column of predictions for each model.
    """

    scores: pd.DataFrame
    locations: pd.DataFrame
    twins: dict[str, Twin]
    predictions: pd.DataFrame

    def tables(self) -> list[tuple[str, dict[str, str], list[list]]]:
        """The tables that are shown: (title, headings with their alignment, rows), scores first."""
        tables = []
        estimated = self.scores[self.scores["positions"] == "estimated"]
        for against, part in estimated.groupby("against", sort=False):
            columns = {"model": "left"} | dict.fromkeys(("RMSE", "MAE", "bias"), "right")
            rows = []
            for model, of_model in part.groupby("model", sort=False):
                of_class = of_model.set_index("links")
                rows.append([model, *("/".join(_short(of_class.loc[links, f"{measure}_db"]) for links in CLASSES)
                                      for measure in ("rmse", "mae", "bias"))])
            links = part.groupby("links")["n"].max()
            counts = "/".join(str(links[name]) for name in CLASSES)
            tables.append((f"Error on {against} [dB]: all/LoS/NLoS of {counts} links", columns, rows))
        summary = self.location_summary()
        if len(summary):
            tables.append(("Error of the unknown devices' positions [m]",
                           {"model": "left", "devices": "right", "median": "right", "90 %": "right", "worst": "right"},
                           [[row.model, int(row.devices), row.median_m, row.p90_m, row.worst_m]
                            for row in summary.itertuples()]))
        return tables

    def location_summary(self) -> pd.DataFrame:
        """Median, 90th percentile and worst error [m] of the unknown devices, for each model."""
        def summary(errors: pd.Series) -> pd.Series:
            return pd.Series({"devices": len(errors), "median_m": errors.median(),
                              "p90_m": errors.quantile(0.9), "worst_m": errors.max()})
        if self.locations.empty or self.locations["error_m"].isna().all():
            return pd.DataFrame(columns=["model", "devices", "median_m", "p90_m", "worst_m"])
        return self.locations.groupby("model", sort=False)["error_m"].apply(summary).unstack().reset_index()


def _short(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def split_flights(measurements: Measurements, held_out: int) -> tuple[Measurements, Measurements]:
    """The last `held_out` flights apart from those before.

    Raises:
        BadInput: fewer flights than it takes to learn from one and hold out the others.
    """
    flights = measurements.flights
    if held_out < 1:
        raise BadInput(f"held-out flights = {held_out}: at least 1 is needed to compare on")
    if len(flights) <= held_out:
        some = "1 flight" if len(flights) == 1 else f"{len(flights)} flights"
        raise BadInput(f"{some} in the measurements ({', '.join(flights[:4])}), {held_out} to be held out: at least {held_out + 1} are needed, so that models are judged on a "
                       "flight that they were not fitted to; survey more flights, or hold out fewer")
    test = measurements.table["flight"].isin(flights[-held_out:]).to_numpy()
    return measurements.select(~test), measurements.select(test)


def compare_models(train: Measurements, test: Measurements, scene: Scene, truth: RadioMap | None, *, seed: int,
                   models: tuple[str, ...] = tuple(MODELS), twins: dict[str, Twin] | None = None,
                   maps: dict[str, RadioMap] | None = None) -> Comparison:
    """Fit every model to the same links and judge all of them on the same others.

    Args:
        train, test: links to learn from and to judge on.
        scene: where both were measured; its devices' true positions are used to judge, never to learn.
        truth: the whole map to judge on, too, where there is one.
        seed: of all fits.
        models: keys of `radiotwin.channel.MODELS`.
        twins: fitted already, judged beside the models, by the name that they get in the tables.
        maps: made already, judged on the truth map.
    """
    true_m = true_positions(scene, train)
    fitted = {}
    with progress("comparing models", total=len(models)) as advance:
        for model in models:
            fitted[model] = fit_twin(train, scene, model=model, seed=seed)
            advance(1)
    fitted |= twins or {}
    los = _los(scene, true_m, test)
    predictions = test.table[["flight", "receiver", "device"]].assign(measured_db=test.level_db, los=los)
    scores, locations = [], []
    for model, twin in fitted.items():
        predicted_db = predict(twin, scene, test.receiver_m, test.device_index, limit_db=twin.limit_db)
        predictions[model] = predicted_db
        scores += _scores(model, "held-out flights", "estimated", test.level_db, predicted_db, los)
        if np.isfinite(true_m).all():
            ideal_db = predict(twin, scene, test.receiver_m, test.device_index, true_m, twin.limit_db)
            scores += _scores(model, "held-out flights", "true", test.level_db, ideal_db, los)
        if truth is not None:
            scores += _map_scores(model, twin, scene, truth, true_m)
        locations += _location_rows(model, twin, true_m)
    for name, candidate in (maps or {}).items():
        scores += score_map(name, candidate, truth)
    return Comparison(pd.DataFrame(scores), pd.DataFrame(locations), fitted, predictions)


def true_positions(scene: Scene, measurements: Measurements) -> np.ndarray:
    """(k, 3) positions of the measurements' devices [m] as the scene declares them, NaN where it does not."""
    declared = {d.device: (d.x_m, d.y_m, d.z_m) for d in scene.config.devices}
    return np.array([declared.get(name, (np.nan,) * 3) for name in measurements.devices["device"]])


def predict(twin: Twin, scene: Scene, receiver_m, device, device_m=None, limit_db: float | None = None) -> np.ndarray:
    """Mean level of links.

    Only detected links can be held against a prediction, and near the limit only the strong ones were detected: the
    mean of all would lie below the mean of those, most for the model with the widest scatter. So every model is
    asked for the mean of what is detected (a truncated normal distribution).

    Args:
        twin: model and device positions.
        scene: with the 3D map.
        receiver_m, device: (n, 3) positions [m] and (n,) rows of the twin's devices.
        device_m: (k, 3) other device positions [m].
        limit_db: of detection; None: the mean of all links.

    Returns:
        (n,) levels [dB]; NaN for devices without a position.
    """
    device_m = twin.device_m if device_m is None else device_m
    known = np.isfinite(device_m).all(axis=1)[device]
    predicted_db = np.full(len(device), np.nan)
    if known.any():
        links = make_links(device_m, receiver_m[known], device[known], scene.city)
        mean_db, sigma_db = twin.channel.predict(links)
        predicted_db[known] = mean_db if limit_db is None else mean_if_detected(mean_db, sigma_db, limit_db)
    return predicted_db


def score_map(name: str, candidate: RadioMap, truth: RadioMap) -> list[dict]:
    """Rows of scores for a radio map against the truth, on the devices and positions of both.

    Raises:
        BadInput: the maps have no device in common, or different lattices.
    """
    common = [device for device in truth.devices if device in candidate.devices]
    if not common or candidate.gain_db.shape[1:] != truth.gain_db.shape[1:] or \
            not np.allclose(candidate.lattice.positions_m, truth.lattice.positions_m):
        raise BadInput(f"map {name} cannot be held against the truth: devices {candidate.devices} on a lattice of "
                       f"{candidate.gain_db.shape[1:]} positions, the truth has {truth.devices} on "
                       f"{truth.gain_db.shape[1:]}; make both for the same scene")
    ours, theirs = ([m.devices.index(device) for device in common] for m in (candidate, truth))
    return _scores(name, "whole map", "estimated", truth.gain_db[theirs].astype(float).ravel(),
                   comparable_db(candidate, truth)[ours].ravel(), truth.los[theirs].ravel())


def comparable_db(candidate: RadioMap, truth: RadioMap) -> np.ndarray:
    """What a map says of the links that are detected: its mean given detection, where the truth is a map of values.

    Returns:
        (device, z, y, x) gain [dB]
    """
    gain_db = candidate.gain_db.astype(float)
    if "sigma_db" not in candidate.dataset or "sigma_db" in truth.dataset:
        return gain_db
    return mean_if_detected(gain_db, candidate.dataset["sigma_db"].values.astype(float),
                            truth.dataset.attrs.get("gain_limit_db", -np.inf))


def _los(scene: Scene, true_m: np.ndarray, links: Measurements) -> np.ndarray:
    """(n,) bool by the true positions; links of devices that the scene does not declare count as NLoS."""
    los = np.zeros(len(links.table), dtype=bool)
    known = np.isfinite(true_m).all(axis=1)[links.device_index]
    los[known] = scene.city.line_of_sight(true_m[links.device_index[known]], links.receiver_m[known])
    return los


def _map_scores(model: str, twin: Twin, scene: Scene, truth: RadioMap, true_m: np.ndarray) -> list[dict]:
    names = [device.device for device in twin.devices]
    rows = [truth.devices.index(name) for name in names]
    receiver_m = truth.lattice.positions_m
    index = np.repeat(np.arange(len(names)), len(receiver_m))
    everywhere_m = np.tile(receiver_m, (len(names), 1))
    gain_db, los = truth.gain_db[rows].astype(float).ravel(), truth.los[rows].ravel()
    # A map of means and deviations has all its means; one of gains has only what is detected.
    limit_db = None if "sigma_db" in truth.dataset else scene.config.gain_limit_db
    scores = []
    for positions, device_m in (("estimated", None), ("true", true_m)):
        predicted_db = predict(twin, scene, everywhere_m, index, device_m, limit_db)
        scores += _scores(model, "whole map", positions, gain_db, predicted_db, los)
    return scores


def _scores(model, against, positions, measured_db, predicted_db, los) -> list[dict]:
    rows = []
    usable = np.isfinite(measured_db) & np.isfinite(predicted_db)
    for links, mask in zip(CLASSES, (usable, usable & los, usable & ~los)):
        error_db = predicted_db[mask] - measured_db[mask]
        measures = {"rmse_db": np.sqrt(np.mean(error_db**2)), "mae_db": np.mean(np.abs(error_db)),
                    "bias_db": np.mean(error_db)} if len(error_db) else \
            {"rmse_db": np.nan, "mae_db": np.nan, "bias_db": np.nan}
        rows.append({"model": model, "against": against, "positions": positions, "links": links,
                     "n": int(mask.sum()), **{k: float(v) for k, v in measures.items()}})
    return rows


def _location_rows(model: str, twin: Twin, true_m: np.ndarray) -> list[dict]:
    return [{"model": model, "device": device.device, "x_m": device.x_m, "y_m": device.y_m,
             "error_m": float(np.hypot(device.x_m - x_m, device.y_m - y_m)),
             "credible_radius_m": device.credible_radius_m, "located": device.located}
            for device, (x_m, y_m, _) in zip(twin.devices, true_m) if device.role == "unknown"]
