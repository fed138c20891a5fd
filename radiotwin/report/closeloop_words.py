"""Put the result of a close-loop into sentences: verdict, causes, errors, what would settle it."""

import re
from collections import Counter
from math import hypot

from radiotwin.closeloop.verdict.criteria import LIKELY, MIN_SURE, SelectionCriteria
from radiotwin.closeloop.verdict.posterior import NONE, OTHER
from radiotwin.effects.registry import effects_named
from radiotwin.io.forms import Origin
from radiotwin.report.anomaly_words import MAX_NAMED, group, seen_from, some_names, where
from radiotwin.report.labels import (
    apart,
    interpolations,
    join_names,
    name_label,
    number,
    origin_of,
    place_words,
    probability,
    variable_label,
)

MIN_DIFFERENCE_DB = 0.5  # of two receivers, to be worth a word: instruments' tolerance
HALF = 0.5  # more probable than not
WHEN = {  # rows of a table of errors
    "before": "before", "after_same_links": "after, the same links", "after": "after",
    "after_with_quality": "after, with each reading's own quality"}
NOT_LOOKED_FOR, LACKING = "not looked for: ", "there is no "  # a reason, and how it goes on


def closeloop_summary(report: dict) -> str:
    """Summarise what `close-loop` found in a few sentences.

    They say which links deviate from the model, the probable causes, and the error on held-out
    links before and after.

    Args:
        report: content of `closeloop.json`.
    """
    return " ".join(summary(report))


def summary(report: dict) -> list[str]:
    """Summarise a close-loop in paragraphs: causes, anomalies (deviating groups of links), advice.

    The causes come first if the verdict is that some were found, else the anomalies.
    """
    why = {"effect": _effect_words, "located": _located_words, "none": _nothing_words,
           "undecided": _undecided_words}[report["verdict"]](report)
    rest = [f"{_side_by_side(each)}." for each in _largest_first(report)
            if _is_significant(each["difference_db"])][:1]
    if _has_interpolation(report):
        rest.append("Interpolation of what remains, which explains nothing, brings the RMSE to "
                    f"{number(rmse_after_db(report['error']))} dB.")
    rest += [with_quality(report), (report.get("prediction") or {}).get("advice", "")]
    parts = [why, where(report)] if report["verdict"] == "effect" else [where(report), why]
    return list(filter(None, [*parts, " ".join(filter(None, rest))]))


def verdict(report: dict) -> str:
    """Return the verdict, with causes or deviating groups of links: "found: receiver drift"."""
    if report["verdict"] == "effect":
        start = "found" if is_sure(report) else "probable"
        return f"{start}: {join_names(cause_names(report))}"
    if report["verdict"] == "located":
        groups = [group(each, origin_of(report))[0] for each in report["anomalies"]]
        return f"located: {some_names(groups)}; cause open"
    return {"none": "nothing stands out"}.get(report["verdict"], report["verdict"])


def cause_names(report: dict) -> list[str]:
    """Return the printed names of the causes that were found, with counts above one.

    Where a device is measured by one receiver alone, the data do not tell which of them has the
    cause: "device gain offset or receiver gain offset".
    """
    counts = Counter(" or ".join(name_label(name) for name in (
        each["name"], *(other for other in each.get("indistinguishable_from", [])
                        if other.partition("_")[2] == each["name"].partition("_")[2])))
        for each in found_causes(report))
    return [name if count == 1 else f"{name} ({count} times)" for name, count in counts.items()]


def objects(report: dict) -> list[str]:
    """Describe each cause with size and place: "a building that the map lacks, 33 by 38 m …"."""
    return [_object_words(each, origin_of(report)) for each in found_causes(report)]


def _object_words(effect: dict, origin: Origin | None) -> str:
    """Describe a cause: devices or receivers, determined size and direction, and single place."""
    forms = effects_named(effect["name"])
    form = next((each for each in forms if each.variant == effect.get("variant")), None)
    words = form and form.in_words or name_label(effect["name"])
    if " of a " in effect.get("variant", ""):
        words = effect["variant"]
    values = {name: each["value"] for name, each in effect["parameters"].items()
              if each["value"] is not None and each.get("determined", True)}
    members = dict.fromkeys(member for name in effect["parameters"]
                            if (member := _member(name)) and is_changed(effect, member))
    names = some_names([f"{member} ({values[key]:+.1f} dB)".replace("-", "−")
                        if (key := f"offset_db[{member}]") in values else member
                        for member in members])
    if members:
        named = re.sub(r"\b(the|a) (device|receiver)\b", lambda _: names, words)
        words = named if named != words else f"{words} ({names})"
    if {"length_m", "width_m"} <= set(values):
        words += f", {values['length_m']:.0f} by {values['width_m']:.0f} m"
    if "height_m" in values:
        words += f", {values['height_m']:.0f} m high"
    if len(members) == 1:
        (member,) = members
        width_deg, azimuth_deg = (values.get(f"{each}_deg[{member}]")
                                  for each in ("beamwidth", "azimuth"))
        if width_deg is not None and azimuth_deg is not None:
            words += f", {width_deg:.0f}° wide, towards {azimuth_deg % 360:.0f}°"
    places = [each for each in effect.get("places", []) if each.get("device", "") in ("", *members)]
    return words + (f", at {place_words(places[0]['x_m'], places[0]['y_m'], origin)}"
                    if len(places) == 1 else "")


def _member(parameter: str) -> str:
    """Return the member in the name of a parameter: `tilt_deg[uav1]` -> `uav1`."""
    return parameter.partition("[")[2].removesuffix("]")


def is_changed(effect: dict, member: str) -> bool:
    """Return whether an effect changes a device or receiver: not if its offset may be 0 dB."""
    offset = effect["parameters"].get(f"offset_db[{member}]")
    return offset is None or not (offset["low"] or 0.0) <= 0.0 <= (offset["high"] or 0.0)


def is_sure(report: dict) -> bool:
    """Return whether every cause that was found has a probability of at least `MIN_SURE`.

    True if no probabilities were computed at all; false if one cause has none, such as a level
    that changes from flight to flight.
    """
    return not report["posterior"] or all(
        (each.get("probability") or 0.0) >= MIN_SURE for each in found_causes(report))


def rivals(report: dict) -> str:
    """Say how probable each found cause is, and what else the first one may be."""
    causes = found_causes(report)
    known = [f"{name_label(each['name'])} {probability(each['probability'])}" for each in causes
             if each.get("probability") is not None]
    text = f"Probability that it is there: {join_names(known)}. " if known else ""
    if not causes or causes[0].get("probability") is None:
        return text
    rank = report["effects"].index(causes[0]) + 1
    # What acts on one flight comes before the steps of which rivals are known.
    step = next((each for each in report["posterior"] if each["step"] == rank), None)
    likely = [] if step is None else _rivals_of(causes[0], step, report)
    return text + (f"What else it may be: {join_names(likely[:MAX_NAMED])}." if likely else "")


def _rivals_of(cause: dict, step: dict, report: dict) -> list[str]:
    """List with probabilities what else a cause that was found at a step may be.

    One minus its probability is divided among the step's other hypotheses, in proportion to their
    probabilities; shares below `LIKELY` are left out.
    """
    named = {each["name"] for each in report["effects"]}
    others = {each["name"]: each["probability"] or 0.0 for each in step["probabilities"]
              if each["name"] not in named
              and not (each["name"] == NONE and report.get("anomalies"))}
    share = min(1.0, (1.0 - cause["probability"]) / max(sum(others.values()), 1e-9))
    same = cause.get("indistinguishable_from", [])
    # A number would say that the data can tell them apart.
    return [*(f"{name_label(name)} (the data cannot tell them apart)" for name in same),
            *(f"{_hypothesis_label(name)} {probability(share * each)}"
              for name, each in others.items() if share * each >= LIKELY and name not in same)]


def undetectable(report: dict) -> str:
    """List the effects that would not have been found at any plausible size; empty if none."""
    names = [name_label(each["name"]) for each in report["detectable"] if each["size"] is None]
    return (f"Not to be seen in a typical form, at any size that they may have: "
            f"{join_names(names)}.") if names else ""


def with_quality(report: dict) -> str:
    """State the RMSE of predictions that also know each reading's quality; empty if none do."""
    known = report["error"].get("after_with_quality")
    if not known:
        return ""
    return (f"Where the quality of each reading is known, as on no map, it is "
            f"{number(known['rmse_db'])} dB.")


def side_by_side(report: dict) -> list[str]:
    """Compare pairs of receivers at common places, a sentence each, largest difference first."""
    return [_side_by_side(each) for each in _largest_first(report)]


def drivers(report: dict) -> list[str]:
    """Return labels of the variables that the final residual, or else the base's, depends on."""
    found = report["remaining"]["drivers"] or [
        each for each in report.get("dependences_before", []) if _meets_criteria(each, report)]
    return [variable_label(each["variable"])[0] for each in found[:MAX_NAMED]]


def is_reference(parameter: dict) -> bool:
    """Return whether a parameter is the fixed offset of 0 dB that other offsets are relative to.

    It has value and interval 0. In another unit that is no reference: a coordinate may be 0.
    """
    known = parameter["value"] == parameter["low"] == parameter["high"] == 0
    return known and parameter.get("unit") == "dB"


def _meets_criteria(dependence: dict, report: dict) -> bool:
    """Return whether a dependence of the residual is significant and large enough to be named."""
    criteria = vars(SelectionCriteria()) | report.get("criteria", {})
    p_value, effect_db = dependence["p_value"], dependence.get("effect_db")
    return p_value is not None and p_value <= criteria["max_dependence_p_value"] and (
        effect_db is None or effect_db >= criteria["min_dependence_db"])


def found_causes(report: dict) -> list[dict]:
    """Return the effects of a report that are causes: no interpolation, no part of the base."""
    interpolated = interpolations()
    return [each for each in report["effects"]
            if each["name"] not in interpolated and not each.get("is_declared")]


def has_additions(report: dict) -> bool:
    """Return whether anything was added to the base: a cause, or an interpolation."""
    return not all(each.get("is_declared") for each in report["effects"])


def errors_in_turn(scores: dict, report: dict) -> list[tuple[str, dict]]:
    """Return label and scores of each error table row; a single row if the base got no addition.

    Args:
        scores: scores of the same links by a key of `WHEN`: `before`, `after` the effects, ….
        report: content of `closeloop.json`.
    """
    labels = WHEN if has_additions(report) else {"before": "before and after"}
    return [(label, scores[when]) for when, label in labels.items() if scores.get(when)]


def _has_interpolation(report: dict) -> bool:
    """Return whether the final model interpolates what no cause explains."""
    return not interpolations().isdisjoint(each["name"] for each in report["effects"])


def _largest_first(report: dict) -> list[dict]:
    """Return the comparisons of receivers, largest difference first."""
    return sorted(report.get("receivers_compared", []),
                  key=lambda each: -abs(each["difference_db"]["value"]))


def _is_significant(difference_db: dict) -> bool:
    """Return whether receivers differ by at least `MIN_DIFFERENCE_DB`, and the interval lacks 0."""
    surely = not difference_db["low"] <= 0 <= difference_db["high"]
    return surely and abs(difference_db["value"]) >= MIN_DIFFERENCE_DB


def _side_by_side(found: dict) -> str:
    """Compare two receivers at common places: "B reads 2.7 dB (0.4 to 4.9) more than A …"."""
    value, low, high = (found["difference_db"][key] for key in ("value", "low", "high"))
    both = (f"where both were, within metres: {found['pairs']:,} pairs of readings at "
            f"{found['places']:,} places")
    first, second = found["first"], found["second"]
    if low <= 0 <= high:
        return (f"{first} and {second} show no difference ({number(low)} to {number(high)} dB) "
                f"{both}")
    if value < 0:
        first, second, value, low, high = second, first, -value, -high, -low
    return (f"{second} reads {number(value)} dB ({number(low)} to {number(high)}) more than "
            f"{first} {both}")


def rmse_after_db(error: dict) -> float:
    """Return the RMSE with the effects [dB], on links that the base predicts, too."""
    return (error.get("after_same_links") or error["after"]).get("rmse_db")


def _effect_words(report: dict) -> str:
    """Say which causes were found, how probable they are, and how far the RMSE falls with them."""
    error = report["error"]
    without_cause = interpolations()
    explained = [each["heldout_rmse_db"] for each in report["candidates"]
                 if each["kept"] and each["name"] not in without_cause]
    interpolated = _has_interpolation(report)
    after = explained[-1] if explained and interpolated else rmse_after_db(error)
    found = found_causes(report)
    it = "it" if len(found) == 1 else "them"  # one kind may have been found twice
    known = [each["probability"] for each in found if each.get("probability") is not None]
    start, sure = "Found", ""
    if not is_sure(report):
        start = "Probable"
        if len(known) == len(found):
            rest = "" if len(found) == 1 else " each" if min(known) == max(known) else " and more"
            sure = f" (probability {probability(min(known))}{rest})"
    before = error["before"]["rmse_db"]
    goes = f"{'falls' if after < before else 'goes'} from {number(before)} to {number(after)} dB"
    if number(before) == number(after):
        goes = f"stays at {number(after)} dB"
    of_links = ""
    if "after_same_links" in error:  # the RMSE is of the base's links, unless interpolated
        of_links = (
            f" (the last of all {error['after']['n']:,} links)" if explained and interpolated
            else f" (the same {error['before']['n']:,} links)")
    text = (f"{start}: {'; '.join(objects(report))}{sure}. With {it} the RMSE on held-out links "
            f"{goes}{of_links}.")
    if error.get("learnable"):
        text += _learnable_words(error, interpolated)
    unnamed = _unnamed_beside(report)
    if unnamed is not None:
        text += (f" Beside {it} something is left that has no name (probability "
                 f"{probability(unnamed)}).")
    if report["remaining"]["drivers"]:
        text += f" The remaining residual depends on {join_names(drivers(report))}."
    return text


def _learnable_words(error: dict, interpolated: bool) -> str:
    """Give both RMSEs without links of a fault or change that only links held out with them show.

    The one after may be that of a model that also interpolates.
    """
    both = error["learnable"]
    count = error["before"]["n"] - both["before"]["n"]
    if not count or not both["before"]["n"]:
        return ""
    before, after = (number(both[when]["rmse_db"]) for when in ("before", "after"))
    end = ", with interpolation" if interpolated else ""
    return (f" {count:,} of these links lie at a fault or a change that only links held out with "
            f"them show; without them it is {before} dB before and {after} dB after{end}.")


def _unnamed_beside(report: dict) -> float | None:
    """Return the probability that, beside the causes found, one outside the catalogue remains.

    None unless it is the likeliest hypothesis of the last step, and at least `HALF`.
    """
    found = report["posterior"][-1]["probabilities"] if report["posterior"] else []
    if not found or found[0]["name"] != OTHER:
        return None
    return found[0]["probability"] if (found[0]["probability"] or 0.0) >= HALF else None


def _nothing_words(report: dict) -> str:
    """Say that no group of links deviates, which deviation would have been found, and the RMSE."""
    before_db = report["error"]["before"]["rmse_db"]
    is_same = before_db is not None and not has_additions(report)
    return " ".join(filter(None, [
        "No group of links stands out, and no cause was found"
        f"{_probability_in_brackets(report, NONE)}.",
        seen_from(report),
        f"The RMSE on held-out links stays at {number(before_db)} dB." if is_same else "",
        _error_split(report)]))


def _located_words(report: dict) -> str:
    """Describe the residual where links deviate without a known cause, and what would settle it."""
    return " ".join(filter(None, [
        f"The {_residual_words(report)}", _not_looked_for(report), _settled_by(report)]))


def _not_looked_for(report: dict) -> str:
    """List effects that could not be tested because the data lack a column or a map."""
    why: dict[str, list[str]] = {}
    for each in report["candidates"]:
        reason = each["reason"].removeprefix(NOT_LOOKED_FOR)
        if reason != each["reason"] and reason.startswith(LACKING):
            lacks = reason.removeprefix(LACKING).split(",")[0]
            form = each.get("variant") and f" ({each['variant']})"
            why[lacks] = [*why.get(lacks, []), name_label(each["name"]) + (form or "")]
    parts = [f"as {LACKING}{lacks}: {join_names(list(dict.fromkeys(names)))}"
             for lacks, names in why.items()]
    return f"Not looked for, {'; '.join(parts)}." if parts else ""


def _residual_words(report: dict) -> str:
    """State the RMSE of the base model's residual [dB], and the variables that it depends on."""
    names = drivers(report)
    depends = f" and depends on {join_names(names)}" if names else ""
    return f"residual is {number(report['error']['before']['rmse_db'])} dB RMSE{depends}."


def _undecided_words(report: dict) -> str:
    """Say that the verdict is undecided, with the likeliest causes and what would settle it."""
    step = next(iter(report["posterior"]), None)
    if step is None:
        return "Undecided: no cause was looked for."
    likely, sizes = _likely(step["probabilities"], report), ""
    what = "whether that is real"
    if not report.get("anomalies"):
        what, sizes = "the cause", _error_split(report)
        none = next((each["probability"] or 0.0 for each in step["probabilities"]
                     if each["name"] == NONE), 0.0)
        if sizes and none >= HALF:
            sizes += " That much at places is not said to be nothing."
    return " ".join(filter(None, [
        f"Undecided: these measurements do not tell {what}.", likely and f"Likeliest: {likely}.",
        f"The {_residual_words(report)}", _not_looked_for(report), _settled_by(report), sizes]))


def _settled_by(report: dict) -> str:
    """Name two measurements at most that decide between the likeliest causes; empty if unknown."""
    step = next(iter(report["posterior"]), None)
    if step is None:
        return ""
    names = [each["name"] for each in step["probabilities"] if (each["probability"] or 0) >= LIKELY]
    advice = list(filter(None, (_settled_for(name, step["step"], report) for name in names)))
    return f"To settle it: {'; '.join(dict.fromkeys(advice[:2]))}." if advice else ""


def _settled_for(name: str, step: int, report: dict) -> str:
    """Say which measurement would settle whether an effect is there; empty if none is known.

    An effect may have a form for devices and one for receivers. That of the most probable trial at
    this step of the search is used, and its devices or receivers are named.
    """
    forms = effects_named(name)
    texts = {each.of_receiver: each.settled_by for each in reversed(forms) if each.settled_by}
    if not texts:
        return ""
    first = next(each.settled_by for each in forms if each.settled_by)
    tried = [each for each in report["candidates"]
             if each["name"] == name and each["step"] == step]
    best: dict = max(tried, key=lambda each: each.get("probability") or 0.0, default={})
    for end in ("device", "receiver"):
        names = best.get(f"{end}s") or []
        if not names:
            continue
        shown = ", ".join(apart(end, each) for each in names[:MAX_NAMED])
        shown += " and others" * (len(names) > MAX_NAMED)
        who = f"{end}{'s' * (len(names) > 1)} {shown}"
        text = texts.get(end == "receiver", first)
        if end == "device" and len(names) == 1 and "the device" in text:
            return text.replace("the device", who)
        return f"{text} ({who})"
    return first


def _likely(probabilities: list[dict], report: dict) -> str:
    """List hypotheses that are at least as probable as `LIKELY`, with probability; else empty.

    "Nothing is missing" is left out if a group of links deviates, which contradicts it.
    """
    likely = [each for each in probabilities if (each["probability"] or 0) >= LIKELY
              and not (each["name"] == NONE and report.get("anomalies"))]
    return join_names([f"{_hypothesis_label(each['name'])} ({probability(each['probability'])})"
                       for each in likely[:MAX_NAMED]])


def _probability_in_brackets(report: dict, name: str) -> str:
    """Return a hypothesis' probability at the first step of the search, in brackets; else empty."""
    step = next(iter(report["posterior"]), None)
    found = {each["name"]: each["probability"] for each in step["probabilities"]} if step else {}
    return f" (probability {probability(found[name])})" if name in found else ""


def split_db(report: dict) -> tuple[float, float] | None:
    """Split the base's RMSE into errors [dB] that repeat at a place, and that differ by reading.

    Their squares add up to that of the RMSE. None if they were not estimated.
    """
    step = next(iter(report["posterior"]), None)
    whole_db = report["error"]["before"]["rmse_db"]
    if step is None or None in (step["rest_db"], step["noise_db"], whole_db):
        return None
    both_db = hypot(step["rest_db"], step["noise_db"])
    places_db, single_db = (whole_db * each / both_db if both_db else 0.0
                            for each in (step["rest_db"], step["noise_db"]))
    return places_db, single_db


def _error_split(report: dict) -> str:
    """Say how much of the base's RMSE repeats at a place; empty if that is not known."""
    parts_db = split_db(report)
    if parts_db is None:
        return ""
    places_db, single_db = parts_db
    alike = "errors of the map and its materials" if _has_map(report) else "shadowing"
    whole_db = report["error"]["before"]["rmse_db"]
    return (f"Of the base's {number(whole_db)} dB, roughly {number(places_db)} dB repeat at a "
            f"place ({alike}), and {number(single_db)} dB differ from reading to reading (squares "
            "add up).")


def _has_map(report: dict) -> bool:
    """Return whether a 3D map was given: without one, every link counts as line of sight."""
    hidden = report["error"].get("by_los", {}).get("nlos")
    given = (report.get("inputs") or {}).get("scene") or report["base"] == "raytrace"
    return bool(given or (hidden and hidden["before"]["n"]))


def _hypothesis_label(name: str) -> str:
    """Return the printed name of a hypothesis: an effect, none, or one outside the catalogue."""
    return {NONE: "nothing is missing",
            OTHER: "something that is not in the catalogue"}.get(name, name_label(name))
