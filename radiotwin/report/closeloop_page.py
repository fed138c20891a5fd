"""Make the page of a close-loop, or its part of a run's page, from `closeloop.json`."""

from itertools import islice
from pathlib import Path
from typing import Any

from radiotwin.closeloop.output.result_file import check_report
from radiotwin.display import count
from radiotwin.effects.registry import effects_named
from radiotwin.report import anomaly_words
from radiotwin.report import closeloop_words as words
from radiotwin.report.html import Picture, Table, read_picture, write_page
from radiotwin.report.labels import (
    apart,
    effect_picture,
    interpolations,
    join_names,
    name_label,
    number,
    parameter_label,
    parameter_labels,
    probability,
    quantity,
    two_digits,
    variable_label,
)

GROUPS = {"los": "with line of sight", "nlos": "without line of sight"}
COLUMNS = {"n": "links", "bias_db": "bias [dB]", "std_db": "standard deviation [dB]",
           "correlation": "correlation", "rmse_db": "RMSE [dB]", "mae_db": "MAE [dB]",
           "nll": "−log-likelihood [nats]"}
LEARNT = {"combined": "all that was learnt together",
          "map": "its map: mean level at a receiver without faults"}
MAX_ROWS = 40  # groups with more members are left out of the tables
MAX_COLUMNS = 30  # of the scores
MAX_MODELS = 100
MAX_EFFECTS = 30  # with a figure each


def write_closeloop_page(report: dict, folder: Path | str, title: str) -> None:
    """Write `closeloop.html`, one file that opens without a network.

    Args:
        report: content of `closeloop.json`.
        folder: of the page and of the figures that go into it.
        title: heading of the page.

    Raises:
        BadInput: a damaged report or figure, or a path that cannot be written.
        RunFailed: the disk is full.
    """
    folder, report = Path(folder), check_report(report)
    write_page("closeloop.html", folder / "closeloop.html", {
        "title": title, "page_title": title, "lead": [], "facts": _facts(report),
        "closeloop": closeloop_context(report, folder)})


def closeloop_context(report: dict, folder: Path) -> dict[str, Any]:
    """Collect the template variables of a close-loop's part of a page (`closeloop_*.html`).

    `report` is a checked `closeloop.json`; `folder` has its figures. BadInput if one is damaged.
    """
    candidates, (lead, *more) = report["candidates"], words.summary(report)
    map_picture, steps, *pictures = _pictures(report, folder)
    return {
        "lead": lead, "more": more, "rivals": words.rivals(report), "cards": _cards(report),
        "map": map_picture, "steps": steps,
        "anomalies": Table(anomaly_words.COLUMNS, anomaly_words.rows(report), "", 3),
        "figures": [picture for picture in pictures if picture],
        "effects": [_effect(each, folder) for each in report["effects"][:MAX_EFFECTS]],
        "more_effects": max(len(report["effects"]) - MAX_EFFECTS, 0),
        "errors": _error_table(report, ("los",)),
        "errors_by_member": _error_table(report, ("device", "receiver", "flight")),
        "detectable": Table(
            ("effect", "would have been named from", "what its size is"),
            [[name_label(each["name"]), f"{two_digits(each['size'])} {each['unit']}",
              each["pattern"]] for each in report["detectable"] if each["size"] is not None]),
        "seen_from": Table(("group", "level from", "scatter from", "blanks from"),
                           anomaly_words.seen_rows(report)),
        "undetectable": words.undetectable(report),
        "side_by_side": words.side_by_side(report),
        "trials": f"{count(len(candidates), 'trial')} in "
                  f"{count(len({c['step'] for c in candidates}), 'step')}",
        "candidates": _candidate_table(candidates),
        "remaining": Table(
            ("variable", "standard deviation of the mean residual over it [dB]", "p, corrected"),
            [[variable_label(driver["variable"])[0], number(driver.get("effect_db")),
              _p_value(driver["p_value"])] for driver in report["remaining"]["drivers"]]),
        "notes": report["notes"]}


def _pictures(report: dict, folder: Path) -> list[Picture | None]:
    """Read the figures of a page: map, steps, groups, levels, dependence; their captions."""
    is_marked = any(each.get("places") for each in words.found_causes(report)) or any(
        each["members"].get("device") for each in report["anomalies"])
    marked = " Purple: what was found." if is_marked else ""
    framed = contribution = ""
    panels: tuple[str, ...] = ()
    if report["anomalies"]:
        framed = " Framed: groups that stand out; dashed: part of their links."
    if words.has_additions(report):
        contribution = " Dashed: contribution of the effects to the prediction."
        panels = ("before", "after")
    return [
        read_picture(folder, "residual_map.png", "Residual on the map",
                     "Measured − predicted level on held-out links, at the position of the moving "
                     f"end; red: less was measured than predicted.{marked}", panels),
        read_picture(folder, "waterfall.png", "Error step by step",
                     "RMSE on held-out links, which were used neither to choose nor to fit the "
                     "model: the base alone, the change by each effect, and the result. Horizontal "
                     "lines: other models, held out in the same way, unless they are far worse."),
        read_picture(folder, "groups.png", "Residual by device, receiver and flight",
                     "Median of the held-out residual of the base (measured minus predicted; red: "
                     f"less was measured) and its scatter.{framed}"),
        read_picture(folder, "level_map.png", "Levels on the map",
                     "Measured level, level predicted while the link was held out, and their "
                     "difference, at the position of the moving end.",
                     ("measured", "predicted", "difference")),
        read_picture(folder, "drivers.png", "Dependence of the residual",
                     "Mean held-out residual over the variables that it depends on most, with one "
                     f"standard error.{contribution} The diffraction parameter (ν of ITU-R P.526) "
                     "says how far the map reaches into the straight line: above 0 it blocks it.")]


def _cards(report: dict) -> list[tuple[str, str]]:
    """Return label and text of up to four headline boxes of the page.

    Verdict; held-out RMSE, before and after if something was added to the base; if not, the part of
    it that repeats at a place; share of held-out readings in their 90 % intervals.
    """
    error, cards = report["error"], [("verdict", words.verdict(report))]
    before = number(error["before"].get("rmse_db"))
    label = f"RMSE of {error['before']['n']:,} links"
    if words.has_additions(report):
        after = number(words.rmse_after_db(error))
        cards.append((f"{label}, before and after", f"{before} → {after} dB"))
    else:
        cards.append((f"{label}, as before", f"{before} dB"))
        parts_db = words.split_db(report)
        if parts_db is not None:
            cards.append(("of that, repeats at a place", f"{number(parts_db[0])} dB"))
    inside = (report["error"].get("combined") or {}).get("in_90_percent_interval")
    if inside is not None:
        cards.append(("held-out readings in 90 % intervals of the twin", f"{100 * inside:.0f} %"))
    return cards


def _effect(effect: dict, folder: Path) -> dict[str, Any]:
    """Return what the page shows of an effect: rank, name, kind, evidence, figure, parameters."""
    name, labels = effect["name"], parameter_labels(effect["name"])
    label = name_label(name)
    kind = ("interpolated, not explained" if name in interpolations() else
            "part of the base" if effect.get("is_declared") else "")
    has_panels = any(each.figure == "links" for each in effects_named(name))
    rows = [[parameter_label(key, labels), _value(p), _interval(p),
             "°" if p["unit"] == "deg" else p["unit"]] for key, p in effect["parameters"].items()]
    return {"rank": effect["rank"], "label": label, "kind": kind, "evidence": _evidence(effect),
            "picture": read_picture(folder, effect_picture(effect["rank"], name), label, "",
                                    ("without it", "with it") if has_panels else ()),
            "parameters": Table(("parameter", "value", "90 % interval", "unit"), rows)}


def _evidence(effect: dict) -> str:
    """Describe an effect: form, probability, RMS change of the links, effects that look alike."""
    text = f"{effect['variant'].capitalize()}. " if effect.get("variant") else ""
    if effect.get("probability") is not None:
        text += f"Probability that it is there: {probability(effect['probability'])}. "
    size = effect.get("size_db")
    if size is not None and size["value"] is None:
        text += "It changes no level, only which links are blank. "
    elif size is not None and not size.get("determined", True):
        text += "By how much it changes the links that it acts on is not determined. "
    elif size is not None:
        text += f"It changes the links that it acts on by {number(size['value'])} dB (RMS"
        text += f"; 90 % interval {_interval(size)}). " if _interval(size) != "–" else "). "
    same = [name_label(name) for name in effect.get("indistinguishable_from", [])]
    alike = [name_label(name) for name in effect.get("confused_with", [])
             if name_label(name) not in same]
    if same:
        text += f" The data cannot distinguish it from {join_names(same)}."
    return text + (f" Effects that may look alike: {join_names(alike)}." if alike else "")


def _error_table(report: dict, kinds: tuple[str, ...]) -> Table:
    """Return the table of held-out errors before and after effects were added, by group of links.

    `kinds` are `device`, `receiver`, `flight` or `los`; one of over `MAX_ROWS` groups is left out.
    With `los`, all links come first, and other models on them.
    """
    rows: list[list[str]] = []
    others = dict(islice(report["baselines"].items(), MAX_MODELS if "los" in kinds else 0))
    columns = list(dict.fromkeys([*COLUMNS, *(key for each in others.values() for key in each)]))
    columns = columns[:MAX_COLUMNS]
    error = report["error"]
    groups = [("all links", error)] if "los" in kinds else []
    for kind in kinds:
        group = report["error"].get(f"by_{kind}", {})
        groups += [(GROUPS.get(name, f"{kind} {apart(kind, name)}"), both)
                   for name, both in group.items()
                   if len(group) <= MAX_ROWS and both["before"]["n"]
                   and (kind != "los" or both["before"]["n"] < report["error"]["before"]["n"])]
    for place, (label, both) in enumerate(groups):
        rows += [["" if row else label, when, *(number(scores.get(key)) for key in columns)]
                 for row, (when, scores) in enumerate(words.errors_in_turn(both, report))]
        if place == 0:
            others = {label: scores for key, label in LEARNT.items()
                      if (scores := error.get(key))} | others
            rows += [["", name_label(name), *(number(scores.get(key)) for key in columns)]
                     for name, scores in others.items()]
    heldout = report["heldout"]
    headings = [COLUMNS.get(key, key.replace("_", " ")) for key in columns]
    return Table(["", "model", *headings], rows,
                 f"On held-out links (by {heldout['by']}, {heldout['folds']} folds)", 2)


def _candidate_table(candidates: list[dict]) -> Table:
    """Return the table of effects that were tried, with decision, probability, RMSE and evidence.

    Those that are kept in the final model are emphasised.
    """
    rows = [[c["step"], _with_variant(c), "kept" if c["kept"] else c["reason"],
             probability(c.get("probability")), number(c["heldout_rmse_db"]),
             number(c.get("evidence_nats")), number(c["heldout_nll_gain"])]
            for c in candidates]
    return Table(("step", "effect", "kept, or why not", "probability by itself",
                  "held-out RMSE [dB]", "evidence [nats]", "held-out gain [nats]"), rows, "", 3,
                 {row for row, c in enumerate(candidates) if c["kept"]})


def _with_variant(candidate: dict) -> str:
    """Return the printed name of a candidate with its form: `antenna pattern: sector`."""
    name, variant = name_label(candidate["name"]), candidate.get("variant")
    return f"{name}: {variant}" if variant else name


def _facts(report: dict) -> list[str]:
    """Return the texts of the footer: version, base model, held-out links, noise of readings."""
    heldout, floor_db = report["heldout"], report["error"]["noise_floor_db"]
    facts = [f"radiotwin {report.get('radiotwin_version', '')}", f"base {report['base']}",
             f"{heldout['n']:,} links held out by {heldout['by']}"]
    if floor_db is not None:
        facts.append(f"standard deviation of repeated measurements {floor_db:.2f} dB")
    return facts


def _value(parameter: dict) -> str:
    """Return the value of a parameter as text, or that the data do not determine it."""
    if words.is_reference(parameter):
        return "0 (reference)"
    known = parameter.get("determined", True)
    return quantity(parameter["value"], parameter["unit"]) if known else "not determined"


def _interval(parameter: dict) -> str:
    """Return the 90 % interval of a parameter as text; a dash if not determined or of width 0."""
    low, high = parameter["low"], parameter["high"]
    unknown = None in (low, high) or low == high or not parameter.get("determined", True)
    unit = parameter["unit"]
    return "–" if unknown else f"{quantity(low, unit)} to {quantity(high, unit)}"


def _p_value(value: float | None) -> str:
    """Return a p-value with three decimals, at least "< 0.001"."""
    return "–" if value is None else "< 0.001" if value < 0.001 else f"{value:.3f}"
