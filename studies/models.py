"""Accuracy of the channel models and of their device positions: `models`."""

import pandas as pd

from radiotwin import compare_models, fly_survey, split_flights
from studies.runner import Study
from studies.tables import load_world, markdown

HELD_OUT, CLASSES = "held-out flights", ("all", "LoS", "NLoS")


def models_cases(seed: int) -> dict[str, dict]:
    """Return RBM in the statistical truth, which has its own noise, and both traced cities."""
    return {f"{scene}-{truth}": {"scene": scene, "truth": truth, "flights": 5,
                                 "pattern": "random-waypoint", "noise_db": noise_db}
            for scene, truth, noise_db in (("rbm", "segmented", 0.0), ("rbm", "traced", 1.0),
                                           ("rdm", "traced", 1.0))}


def score_models(seed: int, settings: dict) -> dict:
    """Fit all channel models to `flights`, and judge them on as many others and on the map.

    Returns:
        `scores` and `locations` of `compare_models` as columns.
    """
    scene, truth = load_world(settings)
    count = settings["flights"]
    flown = fly_survey(scene, truth, flights=2 * count, pattern=settings["pattern"], seed=seed,
                       noise_db=settings["noise_db"])
    comparison = compare_models(*split_flights(flown, count), scene, truth, seed=seed)
    return {"scene_hash": scene.content_hash(), "scores": comparison.scores.to_dict("list"),
            "locations": comparison.locations.to_dict("list")}


def models_table(rows: pd.DataFrame) -> str:
    """Return mean errors over the seeds, and by how much the network's are lower."""
    parts, below = [], []
    for name, seeds in rows.groupby("name"):
        scores, locations = (pd.concat(map(pd.DataFrame, seeds[key]))
                             for key in ("scores", "locations"))
        mean = scores.groupby(["against", "positions", "links", "model"])["rmse_db"].mean()
        # In the statistical truth every map is the law itself, so that the channel alone is judged.
        where, digits = {"RMSE of the channel on held-out flights, at true positions, all / LoS / "
                         "NLoS [dB]": (HELD_OUT, "true")}, (2, 2, 1)
        if name.endswith("traced"):
            where = {"RMSE on held-out flights, all / LoS / NLoS [dB]": (HELD_OUT, "estimated"),
                     "on the whole map [dB]": ("whole map", "estimated")}
            digits = (1, 1, 0)
        lines = []
        for model, found in locations.groupby("model", sort=False):
            error_m = found["error_m"]
            errors_m = (error_m.median(), error_m.quantile(0.9), error_m.max())
            rmse_db = [" / ".join(f"{mean[*each, links, model]:.2f}" for links in CLASSES)
                       for each in where.values()]
            lines.append([f"`{model}`", *rmse_db, *map("{:.{}f}".format, errors_m, digits),
                          f"{(error_m <= found['credible_radius_m']).mean():.0%}"])
        heads = ["model", *where, "position error, median [m]", "90 %", "worst",
                 "within 90 % radius"]
        city, kind = name.split("-")[0].upper(), "Ray-traced" if len(where) > 1 else "Statistical"
        parts.append(markdown(heads, lines, f"{kind} truth, {city}", f" ({len(seeds)} seeds)"))
        if len(where) > 1:
            wide = mean.unstack()
            share = 1 - wide["segmented_nn"] / wide["log_distance"]
            below.append([city, *(f"{100 * share[against, 'estimated', links]:.0f} %"
                                  for against in (HELD_OUT, "whole map") for links in CLASSES[:2])])
    heads = ["city", "held-out flights, all links", "LoS links", "whole map, all links",
             "LoS links"]
    title = "RMSE of `segmented_nn` below that of `log_distance`"
    return "\n\n".join([*parts, markdown(heads, below, title)])


STUDIES = {"models": Study("How good are the channel models?", score_models, models_cases,
                           models_table, seeds=10)}
