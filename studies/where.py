"""Compare the groups found by the scan, and by pivot tables, with the hidden effects: `where`.

    python -m studies where --only calibrate
    python -m studies where --only undeclared
    python -m studies where --only judge

The base is the one that the loop takes; nothing else of it runs. `studies.where_truth` says which
groups are those of an effect. Where a map is off by a metre or two, and by a building or two
beside what is hidden, a group of links most of which it has with the wrong sight is neither right
nor wrong, nor is one of ends that no longer stands out once the links that it has with the wrong
sight are left out.
"""

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from radiotwin import Measurements, Scene
from radiotwin.closeloop.crossfit import CrossFit, make_folds
from radiotwin.closeloop.families import Readings, families_of, units_of
from radiotwin.closeloop.run import fit_base
from radiotwin.closeloop.scan import Anomaly, log_odds_of_groups, scan
from radiotwin.links import prepare_links
from radiotwin.links.checks import move_anchors_out
from radiotwin.links.correlation import moving_end_m
from radiotwin.links.evidence import thin_links
from radiotwin.links.limits import with_usual_limits
from studies.runner import Study
from studies.tables import markdown, number
from studies.where_pivot import THRESHOLD, robust_z, shrunken
from studies.where_truth import (
    ENDS,
    Group,
    Truth,
    holds_mostly,
    is_there,
    rows_of_links,
    truths,
    visibility,
    where_is_right,
)
from tests.undeclared.cases import FAMILIES, OUTSIDE, case
from tests.undeclared.foreign.cases import foreign_case, names, split_of

UNITED = {"noise": "scatter"}  # statistics that are said as another
SURE, NOTICEABLE_DB, MIN_LINKS = 0.9, 1.0, 15
VISIBLE_T = 4.0
OLDER = [*((family, 0) for family in (*FAMILIES, *OUTSIDE)),
         *((family, seed) for family in ("nothing", "pairs") for seed in (1, 2, 3, 4))]


def where_cases(seed: int) -> dict[str, dict]:
    """Return the foreign cases, as `calibrate/city00-w0-c0`, and 24 older ones; seed 0 only."""
    if seed:
        return {}
    return ({f"{split_of(name)}/{name}": {"case": name} for name in names()}
            | {f"undeclared/{family}-{number}": {"family": family, "number": number}
               for family, number in OLDER})


def say_where(seed: int, settings: dict) -> dict:
    """Scan a case, and compare the groups found with the links of the hidden effects."""
    measurements, scene, effects, changes_db, true_los = hidden_case(settings)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = base_of(measurements, scene, seed)
        anomalies = scan(Readings.of(model))
    return compare(model, anomalies, measurements, effects, changes_db, true_los)


def hidden_case(settings: dict) -> tuple[Measurements, Scene, list[dict], list[np.ndarray],
                                         np.ndarray | None]:
    """Return a case: measurements, scene, effects, what each changes (rows,) [dB], true sight."""
    if "case" in settings:
        foreign = foreign_case(settings["case"])
        return (foreign.measurements, foreign.scene, foreign.answer["effects"],
                list(foreign.changes_db), foreign.los)
    older = case(settings["family"], settings["number"])
    effects = older.answer["effects"]
    change_db = older.clean_gain_db - older.plain_gain_db
    return older.measurements, older.scene, effects, [change_db] * len(effects), None


def base_of(measurements: Measurements, scene: Scene, seed: int) -> CrossFit:
    """Return the base that `close_loop` takes."""
    links = move_anchors_out(prepare_links(measurements, scene), scene)
    links = with_usual_limits(thin_links(links, seed))
    return fit_base(links, scene, make_folds(links, seed), seed=seed)[2]


def compare(model: CrossFit, anomalies: Sequence[Anomaly], measurements: Measurements,
            effects: list[dict], changes_db: list[np.ndarray], true_los: np.ndarray | None
            ) -> dict[str, Any]:
    """Return a row: the hidden effects, and what the scan and both pivot tables say of them."""
    links, residual_db = model.links, model.links.level_db - model.held_out_mean_db
    row_of = rows_of_links(links, measurements)
    hidden = truths(effects, [change_db[row_of] for change_db in changes_db], links)
    wrong = np.zeros(len(links), dtype=bool) if true_los is None else true_los[row_of] != links.los
    heard = np.isfinite(links.level_db)
    ends = {end: np.array(getattr(links, f"{end}_names"), dtype=object)[getattr(links, end)]
            for end in ENDS}
    by_median = robust_z(residual_db, ends, links.los)
    moving_m = moving_end_m(links)[:, :2]
    by_places = shrunken(residual_db, ends, links.los, moving_m)
    # Where no link has the wrong sight, no group stands out because of the map.
    stays = _ends_without(Readings.of(model), wrong) if wrong.any() else None
    stays_by_places = {_ends_of(each) for each in shrunken(
        np.where(wrong, np.nan, residual_db), ends, links.los, moving_m)
        if each.score >= THRESHOLD} if wrong.any() else None
    said = [each for each in anomalies if each.probability >= SURE]
    said_by_places = [each for each in by_places if each.score >= THRESHOLD]
    return {
        "hidden": [{"name": one.name, "ends": {end: sorted(its) for end, its in one.ends.items()},
                    "size_db": one.size_db, "links": int((one.acts & heard).sum()),
                    "t": visibility(one, residual_db, links),
                    "right": where_is_right(said, one, heard),
                    "by_places": where_is_right(said_by_places, one, heard),
                    "first_by_places": where_is_right(by_places[:1], one, heard),
                    "first_by_median": where_is_right(by_median[:1], one, heard),
                    "almost": max((each.probability for each in anomalies
                                   if is_there(each, one, heard)), default=0.0)}
                   for one in hidden],
        "said": [_said(each, each.probability, float(each.size.value), hidden, wrong, heard, stays)
                 for each in anomalies],
        "by_places": [_said(each, each.score, each.shift, hidden, wrong, heard, stays_by_places)
                      for each in said_by_places[:8]],
        "by_median": [_said(each, each.score, each.shift, hidden, wrong, heard, None)
                      for each in by_median[:1]],
        "top_score": by_places[0].score if by_places else 0.0,
        "rmse_db": model.rmse_db(), "links": len(links)}


Ends = tuple[str, frozenset, str]
"""Family, members and statistic of a group."""


def _ends_of(group: Any) -> Ends:
    return group.family, frozenset(group.members.items()), group.statistic


def _ends_without(readings: Readings, wrong: np.ndarray) -> set[Ends]:
    """Return groups of ends that are likelier than not without some links (n,)."""
    left = replace(readings, residual_db=np.where(wrong, np.nan, readings.residual_db),
                   blank_excess=np.where(wrong, np.nan, readings.blank_excess))
    units = units_of(left)
    families = [each for each in families_of(left, units)
                if each.name in ENDS or each.pairs]
    return {(table.family.name, frozenset(table.family.describe(int(group))[0].items()),
             UNITED.get(table.statistic, table.statistic))
            for table in log_odds_of_groups(left, families, units)
            for group in np.flatnonzero(table.log_odds > 0)}


def _said(group: Group, sure: float, size: float, hidden: list[Truth], wrong: np.ndarray,
          heard: np.ndarray, stays: set[Ends] | None) -> dict:
    there = any(is_there(group, one, heard) for one in hidden)
    of_map = holds_mostly(group, wrong, heard) or (
        stays is not None and not getattr(group, "ranges", {}) and _ends_of(group) not in stays)
    members = " ".join("+".join(its) for its in group.members.values())
    ranges = "".join(f" {name} {low:.0f}..{high:.0f}"
                     for name, (low, high) in getattr(group, "ranges", {}).items())
    rows = group.rows
    return {"group": f"{group.family} {members}{ranges}".strip(), "statistic": group.statistic,
            "sight": getattr(group, "sight", "all"), "size": float(size), "sure": float(sure),
            "links": int(rows.sum() if rows.dtype == bool else len(rows)),
            "is": "there" if there else "map" if of_map else "not there"}


def where_table(rows: pd.DataFrame) -> str:
    """Return the table of right and false groups, by split."""
    rows = rows.assign(split=rows["name"].str.split("/").str[0])
    splits = {split: list(part.itertuples()) for split, part in rows.groupby("split")}
    figures = [_figures(part) for part in splits.values()]
    return "\n\n".join([
        markdown(["", *splits], [[name, *(each[name] for each in figures)] for name in figures[0]],
                 "Where", f" (groups with a probability of {SURE:g} and more; effects of "
                 f"{NOTICEABLE_DB:g} dB RMS and more on at least {MIN_LINKS} links that they "
                 "act on)"),
        markdown(["effect", *(f"{split}: {head}" for split in splits for head in FAMILY_HEADS)],
                 _by_effect(splits), "By effect", " (right of cases)")])


FAMILY_HEADS = ("scan", "places", "median")


def counts(one: dict) -> bool:
    """Return whether a hidden effect is large enough to be counted."""
    return one["size_db"] >= NOTICEABLE_DB and one["links"] >= MIN_LINKS


def false_groups(row: Any, of: str = "said") -> list[dict]:
    """Return the groups reported with certainty that belong to no hidden effect."""
    return [each for each in getattr(row, of) if each["is"] == "not there"
            and (of != "said" or each["sure"] >= SURE)]


def _figures(rows: list[Any]) -> dict[str, str]:
    large = [one for row in rows for one in row.hidden if counts(one)]
    seen = [one for one in large if one["t"] is not None and one["t"] >= VISIBLE_T]
    nulls = [row for row in rows if not row.hidden]
    found = {}
    for title, right, said in (("scan", "right", "said"),
                               ("pivot table with places (6 and more)", "by_places", "by_places"),
                               ("pivot table with places, first group", "first_by_places", None),
                               ("pivot table of medians, first group", "first_by_median", None)):
        found[f"{title}: where right"] = _share(one[right] for one in large)
        found[f"{title}: … where the true change shows (t of {VISIBLE_T:g})"] = _share(
            one[right] for one in seen)
        if said:
            found[f"{title}: groups not there, a case"] = number(
                float(np.mean([len(false_groups(row, said)) for row in rows])), 3)
            found[f"{title}: nulls with any"] = _share(
                bool(false_groups(row, said)) for row in nulls)
    return found


def _share(values: Iterable[bool]) -> str:
    found = list(values)
    return f"{sum(found)} of {len(found)}" if found else "–"


def _by_effect(splits: dict[str, list[Any]]) -> list[list[str]]:
    every = [one for rows in splits.values() for row in rows for one in row.hidden if counts(one)]
    lines = []
    for name in sorted({one["name"] for one in every}):
        cells = []
        for rows in splits.values():
            its = [one for row in rows for one in row.hidden if counts(one) and one["name"] == name]
            cells += [_share(one[key] for one in its)
                      for key in ("right", "by_places", "first_by_median")]
        lines.append([f"`{name}`", *cells])
    return lines


STUDIES = {"where": Study("Does the scan say where something is?", say_where, where_cases,
                          where_table, seeds=1)}
