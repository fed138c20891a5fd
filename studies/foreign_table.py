"""Table and figures of the study of foreign worlds."""

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from studies.foreign_roc import detection_rates
from studies.tables import markdown, number

UNNAMED = frozenset({"correlated_shadowing", "unexplained_trend"})  # these explain nothing
PHYSICS = frozenset({"wall_reflection", "diffraction"})  # of every traced world
CONFIDENT, NOTICEABLE_DB = 0.9, 1.0
TELLING = 0.95  # of the error without effects: what the true ones leave, where they show
BINS = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.97, 1.0)
SPLITS = ("calibrate", "judge")


def foreign_table(rows: pd.DataFrame) -> str:
    """Return what was said of each split, families and probabilities."""
    splits = [(split, rows[rows["split"] == split]) for split in SPLITS]
    splits = [(split, part) for split, part in splits if len(part)]
    return "\n\n".join([
        markdown(["", *(split for split, _ in splits)], _summary([part for _, part in splits]),
                 "What was said", " (RMSE of held-out links)"),
        markdown(["probability given", *(f"{split}: true of statements" for split, _ in splits)],
                 _reliability_lines([part for _, part in splits]), "Reliability"),
        markdown(["hidden", *(f"{split}: {head}" for split, _ in splits for head in FAMILY_HEADS)],
                 _family_lines([part for _, part in splits]), "By family",
                 f" (first of cases; missed although of {NOTICEABLE_DB:g} dB and more; true "
                 "parameters in their 90 % intervals)"),
        markdown(["hidden", *(f"{split}: {head}" for split, _ in splits for head in ROC_HEADS)],
                 _roc_lines([part for _, part in splits]), "False alarms",
                 " (share of the cases with an effect in which its score is higher than in all but "
                 "1 % or 5 % of the cases without it)"),
        markdown(["case", "effect", "size", "would have been named from"], _missed_lines(rows),
                 "Missed", " although as large as would have been named")])


FAMILY_HEADS = ("first", "missed", "in intervals")
ROC_HEADS = ("probability, 1 %", "5 %", "held-out likelihood alone, 1 %", "5 %")


def physical(row: Any) -> list[tuple[str, float | None]]:
    """Return the names of causes that a case was given, with their probabilities, in order."""
    return [(name, probability) for name, probability in zip(row.named, row.probabilities)
            if name not in UNNAMED | PHYSICS]


def in_catalogue(row: Any) -> set[str]:
    """Return the names of the hidden effects that the catalogue has."""
    return {each["name"] for each in row.hidden if each["in_catalogue"]}


def false_names(row: Any, least: float = 0.0) -> list[str]:
    """Return names of causes that are not in a case, of at least a probability (none given: 1)."""
    return [name for name, probability in physical(row)
            if name not in in_catalogue(row) | set(row.tolerated)
            and (1.0 if probability is None else probability) >= least]


def is_first(row: Any) -> bool:
    """Return whether the first cause named is hidden."""
    causes = [name for name, _ in physical(row) if name not in row.tolerated]
    return bool(causes) and causes[0] in in_catalogue(row)


def _summary(parts: list[pd.DataFrame]) -> list[list[str]]:
    found = [_figures_of(list(part.itertuples())) for part in parts]
    return [[name, *(each[name] for each in found)] for name in found[0]]


def _figures_of(rows: list[Any]) -> dict[str, str]:
    known = [row for row in rows if row.hidden and all(e["in_catalogue"] for e in row.hidden)]
    outside = [row for row in rows if row.hidden and not in_catalogue(row)]
    mixed = [row for row in rows if row.hidden and row not in known and row not in outside]
    nulls = [row for row in rows if not row.hidden]
    held = [each for row in rows for each in row.parameters if has_interval(each)]
    best = [(row.combined["rmse_db"], min(row.baselines.values())) for row in rows if row.baselines]
    seen = [(name in row.named, size >= least) for row in rows for name, size, least in row.seen]
    return {
        "right first, of cases of the catalogue": _share(map(is_first, known)),
        f"… of those of {NOTICEABLE_DB:g} dB and more": _share(
            is_first(row) for row in known if row.size_db >= NOTICEABLE_DB),
        "… of those where being told the truth lowers the error by "
        f"{100 - 100 * TELLING:.0f} % and more": _share(
            is_first(row) for row in known
            if row.oracle_rmse_db <= TELLING * row.before["rmse_db"]),
        "right first, of cases with one of either kind": _share(map(is_first, mixed)),
        "false names a case of the catalogue": number(
            float(np.mean([len(false_names(row)) for row in known])) if known else None, 2),
        "nulls that were given a cause": _share(bool(false_names(row)) for row in nulls),
        f"nulls, with probability of {CONFIDENT:g} and more": _share(
            bool(false_names(row, CONFIDENT)) for row in nulls),
        f"not in the catalogue, given a cause with {CONFIDENT:g} and more": _share(
            bool(false_names(row, CONFIDENT)) for row in outside),
        "true parameters in their 90 % intervals": _share(map(holds, held)),
        "named, of effects as large as would have been seen": _share(
            named for named, large in seen if large),
        "named, of smaller ones": _share(named for named, large in seen if not large),
        "error after / oracle, median": _ratio(
            [(row.after["rmse_db"], row.oracle_rmse_db) for row in rows]),
        "combined prediction / best baseline, median": _ratio(best),
        "cases where a baseline is better by 2 % and more": _share(
            after > 1.02 * other for after, other in best)}


def _share(values: Iterable[bool]) -> str:
    found = list(values)
    return f"{sum(found)} of {len(found)}" if found else "–"


def _ratio(pairs: list[tuple[float, float]]) -> str:
    ratios = [a / b for a, b in pairs if a is not None and b]
    return f"{np.median(ratios):.2f}" if ratios else "–"


def has_interval(parameter: dict) -> bool:
    """Return whether a reported parameter has an interval that is wider than nothing."""
    return (parameter["determined"] and None not in (parameter["low"], parameter["high"])
            and parameter["low"] < parameter["high"])


def holds(parameter: dict) -> bool:
    """Return whether its interval holds the truth."""
    return parameter["low"] <= parameter["truth"] <= parameter["high"]


def reliability(rows: pd.DataFrame) -> list[tuple[float, float, int]]:
    """Return mean probability, share that is true, and number of the statements in each bin."""
    said = [(probability, bool(true)) for each in rows["statements"]
            for _, probability, true in each]
    if not said:
        return []
    probability, true = np.array(said, dtype=float).T
    bins = np.digitize(probability, BINS[1:-1])
    return [(float(probability[bins == one].mean()), float(true[bins == one].mean()),
             int((bins == one).sum())) if (bins == one).any() else (np.nan, np.nan, 0)
            for one in range(len(BINS) - 1)]


def _reliability_lines(parts: list[pd.DataFrame]) -> list[list[str]]:
    found = [reliability(part) for part in parts]
    if not any(found):
        return [["none given", *("–" for _ in parts)]]
    return [[f"{low:g} to {high:g}", *(
        f"{each[one][1]:.0%} of {each[one][2]}" if each and each[one][2] else "–"
        for each in found)] for one, (low, high) in enumerate(zip(BINS[:-1], BINS[1:]))]


def _family_lines(parts: list[pd.DataFrame]) -> list[list[str]]:
    rows = [list(part.itertuples()) for part in parts]
    every = Counter(name for part in rows for row in part for name in row.families)
    lines = []
    for family in sorted(every):
        cells = []
        for part in rows:
            its = [row for row in part if family in row.families]
            name = {"sector_antenna": "antenna_pattern", "tilted_dipole": "antenna_pattern",
                    "noise_floor": "noise_floor_censoring"}.get(family, family)
            alone = [row for row in its if len(row.families) == 1]
            held = [holds(each) for row in its for each in row.parameters
                    if each["name"] == name and has_interval(each)]
            known = any(name in in_catalogue(row) for row in its)
            missed = [row for row in alone if row.size_db >= NOTICEABLE_DB
                      and name not in row.named]
            cells += [_share(map(is_first, alone)) if known else "not in the catalogue",
                      str(len(missed)) if known else "–", _share(held)]
        lines.append([f"`{family}`", *cells])
    return lines


def _roc_lines(parts: list[pd.DataFrame]) -> list[list[str]]:
    found = [detection_rates(part) for part in parts]
    names = sorted({name for each in found for name in each})
    return [[f"`{name}`" if name != "all" else "all", *(
        number(share, 2) for each in found
        for share in each.get(name, (None,) * len(ROC_HEADS)))] for name in names]


def _missed_lines(rows: pd.DataFrame) -> list[list[str]]:
    return [[row.name, f"`{name}`", number(size, 1), number(least, 1)]
            for row in rows.itertuples(index=False) for name, size, least in row.seen
            if size >= least and name not in row.named] or [["none", "–", "–", "–"]]
