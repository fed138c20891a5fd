"""Error reduction by each physical term on a real campus, by least squares: `terms`.

Levels of the sectors, and the coefficients of each term, are fitted to the links outside a fold.
The antennas are told (published azimuths), so that no search has a part in the answer.
"""

import numpy as np
import pandas as pd

from radiotwin.closeloop.crossfit import make_folds
from radiotwin.closeloop.output.residuals import rmse_db
from radiotwin.effects.antennas import SectorPattern, sector_pattern_db
from radiotwin.links import Links, prepare_links
from radiotwin.links.checks import SURE, chance_inside
from radiotwin.propagation.laws.followed_paths import interaction_gains
from radiotwin.propagation.laws.kriging import ResidualField
from studies.campus import SPLITS, campus
from studies.closeloop_real import AZIMUTHS_DEG
from studies.runner import Study
from studies.tables import markdown, number

DIFFUSE_DB, DIFFUSE_EXPONENT = -125.0, 3.0  # power beside the paths, at 100 m
POSITION_SD_M, DRAWS = 6.0, 16  # of a phone's receiver, for the chance of line of sight
WAYS = ("block", "quadrant")
FEW = (500, 2000)  # scattered readings that are learnt from


def by_class(values: np.ndarray, los: np.ndarray) -> np.ndarray:
    """Return (n, 2) columns: the values of links with line of sight, and of those without."""
    return np.column_stack([values * los, values * (1 - los)])


def quick_terms_of(links: Links) -> dict[str, np.ndarray]:
    """Return the columns (n, …) of terms that need no ray paths, by name."""
    city = links.city
    assert city is not None
    los, decades = links.los.astype(float), np.log10(links.distance_m / 100)
    pattern_db = np.zeros(len(links))
    for row, name in enumerate(links.device_names):
        own = links.device == row
        pattern_db[own] = sector_pattern_db(
            links.azimuth_deg[own], np.zeros(own.sum()),
            SectorPattern(azimuth_deg=float(AZIMUTHS_DEG[name])))
    return {
        "sector": (links.device[:, None] == np.arange(len(links.device_names))).astype(float),
        "distance": decades[:, None],
        "LoS class": np.column_stack([los, decades * los]),
        "antenna": pattern_db[:, None],
        "indoors": city.inside(links.receiver_m)[:, None].astype(float),
        "chance of being indoors": np.where(
            links.los, 0.0, chance_inside(city, links.receiver_m))[:, None]}


def terms_of(links: Links, seed: int) -> dict[str, np.ndarray]:
    """Return columns (n, …) of each term, by name."""
    city = links.city
    assert city is not None
    los, decades = links.los.astype(float), np.log10(links.distance_m / 100)
    device_m = links.device_m[links.device]
    rng, seen = np.random.default_rng(seed), np.zeros((2, len(links)))
    for _ in range(DRAWS):
        there_m = links.receiver_m + np.append(
            rng.normal(0, POSITION_SD_M, (len(links), 2)), np.zeros((len(links), 1)), axis=1)
        outdoors = ~city.inside(there_m)
        seen += outdoors, outdoors & city.line_of_sight(device_m, there_m)
    chance = np.where(seen[0] > 0, seen[1] / np.maximum(seen[0], 1), los)
    gains = interaction_gains(links.geometry)
    diffuse = 10 ** (DIFFUSE_DB / 10) * (links.distance_m / 100) ** -DIFFUSE_EXPONENT
    level_db = {kinds: 10 * np.log10(gains[:, :kinds].sum(axis=1) + diffuse) for kinds in (2, 3)}
    return quick_terms_of(links) | {
        "elevation": links.elevation_deg[:, None],
        "metres inside": np.log1p(city.metres_inside(device_m, links.receiver_m))[:, None],
        "woods and parks": np.log1p(city.vegetation.metres_through(device_m, links.receiver_m)
                                    )[:, None],
        "chance of LoS": np.column_stack([chance, decades * chance]),
        "reflections": by_class(level_db[2], los),
        "reflections, diffraction": by_class(level_db[3], los)}


MODELS: dict[str, tuple[str, ...]] = {
    "log-distance": ("distance",),
    "+ LoS class": ("distance", "LoS class"),
    "+ antenna": ("distance", "antenna"),
    "+ antenna, LoS class": ("distance", "antenna", "LoS class"),
    **{f"+ antenna, LoS class, {extra}": ("distance", "antenna", "LoS class", extra)
       for extra in ("elevation", "metres inside", "woods and parks", "indoors", "chance of LoS",
                     "reflections", "reflections, diffraction")},
    "+ antenna, reflections, diffraction": ("distance", "antenna", "reflections, diffraction"),
    "+ all": ("distance", "antenna", "LoS class", "elevation", "metres inside", "woods and parks",
              "indoors", "chance of LoS", "reflections, diffraction")}

INDOORS: dict[str, tuple[str, ...]] = {"+ antenna, LoS class": MODELS["+ antenna, LoS class"]} | {
    f"+ antenna, LoS class, {extra}": ("distance", "antenna", "LoS class", extra)
    for extra in ("indoors", "chance of being indoors")}

FEW_MODELS: dict[str, tuple[str, ...]] = {
    "distance, LoS class": MODELS["+ LoS class"],
    "distance, LoS class, antenna": MODELS["+ antenna, LoS class"]}


def terms_cases(seed: int) -> dict[str, dict]:
    """Return the settings with all readings (seed 0), and with few."""
    every: dict[str, dict] = {} if seed else {"all": {}, "indoors": {"only": "indoors"}}
    return every | {f"few-{count}": {"readings": count} for count in FEW}


def fit_terms(seed: int, settings: dict) -> dict:
    """Fit models of terms; return held-out errors by split, or learning from few readings."""
    with campus() as (measured, scene):
        links = prepare_links(measured, scene)
        if "readings" in settings:
            return {"links": len(links), "few": _learnt_from_few(links, settings["readings"], seed)}
        models = INDOORS if settings.get("only") == "indoors" else MODELS
        terms = quick_terms_of(links) if models is INDOORS else terms_of(links, seed)
    found = {}
    for way in WAYS:
        fold = make_folds(links, seed, way).index
        found[way] = {name: _held_out_rmse_db(terms, chosen, links.level_db, fold)
                      for name, chosen in models.items()}
    result = {"links": len(links), "los": float(links.los.mean()), "rmse_db": found}
    if models is INDOORS:
        result |= _indoors(links.level_db, terms)
    return result


def _learnt_from_few(links: Links, count: int, seed: int) -> dict[str, list[float]]:
    """Return errors on all readings but the few learnt from: terms alone, and with kriging."""
    terms, found = quick_terms_of(links), {}
    order = np.random.default_rng(seed).permutation(len(links))
    learnt, others = np.sort(order[:count]), np.sort(order[count:])
    for name, chosen in FEW_MODELS.items():
        rest_db = _rest_db(terms, chosen, links.level_db, learnt)
        sd_db = float(rest_db[learnt].std())
        field = ResidualField().fit(links.device[learnt], links.receiver_m[learnt],
                                    rest_db[learnt] / sd_db, seed)
        mean, _ = field.predict(links.device[others], links.receiver_m[others])
        found[name] = [rmse_db(rest_db[others]), rmse_db(rest_db[others] - sd_db * mean)]
    return found


def _indoors(level_db: np.ndarray, terms: dict[str, np.ndarray]) -> dict:
    """Count links with an indoor receiver, and return how much weaker they are [dB]."""
    chance, told = terms["chance of being indoors"][:, 0], terms["indoors"][:, 0] > 0
    rest_db = _rest_db(terms, MODELS["+ antenna, LoS class"], level_db, chance == 0)
    groups = {"indoors by the map, surely": told & (chance >= SURE),
              "indoors by the map, perhaps": told & (chance < SURE),
              "outdoors by the map, perhaps indoors": ~told & (chance >= 1 - SURE)}
    return {"groups": {name: {"links": int(rows.sum()),
                              "median_db": float(np.median(rest_db[rows]))}
                       for name, rows in groups.items()}}


def _held_out_rmse_db(terms: dict[str, np.ndarray], chosen: tuple[str, ...], level_db: np.ndarray,
                      fold: np.ndarray) -> float:
    error_db = np.full(len(level_db), np.nan)
    for each in np.unique(fold):
        out = fold == each
        error_db[out] = _rest_db(terms, chosen, level_db, ~out)[out]
    return rmse_db(error_db)


def _rest_db(terms: dict[str, np.ndarray], chosen: tuple[str, ...], level_db: np.ndarray,
             learnt: np.ndarray) -> np.ndarray:
    """Fit the terms to the training rows; return the residual (n,) of all levels [dB]."""
    columns = np.column_stack([terms["sector"], *(terms[each] for each in chosen)])
    weights = np.linalg.lstsq(columns[learnt], level_db[learnt], rcond=None)[0]
    return level_db - columns @ weights


def terms_table(rows: pd.DataFrame) -> str:
    """Return errors by model and split."""
    few = rows["name"].str.startswith("few-")
    learnt, rows = rows[few], rows[~few]
    titles = {"all": "What each part brings", "indoors": "Indoors by the map, or probably"}
    parts = [markdown(["model", *(SPLITS[way] for way in WAYS)],
                      [[model, *(number(row["rmse_db"][way][model], 2 + (name == "indoors"))
                                 for way in WAYS)] for model in row["rmse_db"][WAYS[0]]],
                      titles[name], ": least squares told the azimuths, RMSE [dB]")
             for name, row in rows.set_index("name").iterrows()]
    parts += [markdown(["receiver", "links", "median [dB]"],
                       [[name, f"{group['links']:,}", number(group["median_db"], 1)]
                        for name, group in groups.items()],
                       "Beside walls and behind them",
                       ": level beside what is predicted outdoors")
              for groups in rows.get("groups", pd.Series()).dropna()]
    if len(learnt):
        parts.append(_few_table(learnt))
    return "\n\n".join(parts)


def _few_table(rows: pd.DataFrame) -> str:
    counts = rows.groupby(rows["name"].str.removeprefix("few-").astype(int))
    lines = [[f"{count:,}", *(number(value, 2) for name in FEW_MODELS
                              for value in np.mean([each[name] for each in group["few"]], axis=0))]
             for count, group in counts]
    seeds = rows["seed"].nunique()
    return markdown(["readings", *(f"{name}{rest}" for name in FEW_MODELS
                                   for rest in ("", ", and kriging"))], lines,
                    "Learnt from few readings",
                    f", scattered, told the azimuths: RMSE of all others [dB], {seeds} seeds")


STUDIES = {"terms": Study("What does each part of the physics bring on a real campus?", fit_terms,
                          terms_cases, terms_table)}
