"""Say in sentences what a close-loop found, how probable it is and what would have been seen."""

import re
from collections import Counter
from math import hypot

from radiotwin.closeloop.verdict.criteria import LIKELY, MIN_SURE, SelectionCriteria
from radiotwin.closeloop.verdict.posterior import NONE, OTHER
from radiotwin.effects.registry import effects_named
from radiotwin.io.forms import Origin
from radiotwin.report.anomaly_words import MAX_NAMED, group, seen_from, some_names, where
from radiotwin.report.labels import (
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
NOT_LOOKED_FOR, LACKING = "not looked for: ", "there is no "  # a reason, and how it goes on


def closeloop_summary(report: dict) -> str:
    """Summarise the result of a close-loop in a few sentences: where, why, and the error.

    Args:
        report: content of `closeloop.json`.
    """
    return " ".join(summary(report))


def summary(report: dict) -> list[str]:
    """Summarise the result in paragraphs: what was found or where, what speaks for it, advice."""
    why = {"effect": _effect, "located": _located, "none": _none,
           "undecided": _undecided}[report["verdict"]](report)
    rest = [f"{_side_by_side(each)}." for each in _largest_first(report)
            if _differ(each["difference_db"])][:1]
    if _has_interpolation(report):
        rest.append("Interpolation of what remains, which explains nothing, brings the RMSE to "
                    f"{number(report['error']['after']['rmse_db'])} dB.")
    rest += [with_quality(report), (report.get("prediction") or {}).get("advice", "")]
    parts = [why, where(report)] if report["verdict"] == "effect" else [where(report), why]
    return list(filter(None, [*parts, " ".join(filter(None, rest))]))


def verdict(report: dict) -> str:
    """Return the verdict in a few words, with the names that it is about."""
    if report["verdict"] == "effect":
        start = "found" if is_sure(report) else "probable"
        return f"{start}: {join_names(cause_names(report))}"
    if report["verdict"] == "located":
        groups = [group(each, origin_of(report))[0] for each in report["anomalies"]]
        return f"located: {some_names(groups)}; cause open"
    return {"none": "nothing stands out"}.get(report["verdict"], report["verdict"])


def cause_names(report: dict) -> list[str]:
    """Return the names of the effects that explain something, with counts.

    Where two ends never part, the same effect of the other end has an equal claim.
    """
    counts = Counter(" or ".join(name_label(name) for name in (
        each["name"], *(other for other in each.get("indistinguishable_from", [])
                        if other.partition("_")[2] == each["name"].partition("_")[2])))
        for each in causes(report))
    return [name if count == 1 else f"{name} ({count} times)" for name, count in counts.items()]


def objects(report: dict) -> list[str]:
    """Name what was found, with size and place: "a building that the map lacks, 33 by 38 m …"."""
    return [_object(each, origin_of(report)) for each in causes(report)]


def _object(effect: dict, origin: Origin | None) -> str:
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
        wide, towards = (values.get(f"{each}_deg[{member}]") for each in ("beamwidth", "azimuth"))
        if wide is not None and towards is not None:
            words += f", {wide:.0f}° wide, towards {towards % 360:.0f}°"
    places = [each for each in effect.get("places", []) if each.get("device", "") in ("", *members)]
    return words + (f", at {place_words(places[0]['x_m'], places[0]['y_m'], origin)}"
                    if len(places) == 1 else "")


def _member(parameter: str) -> str:
    """Return of which member a parameter is: `tilt_deg[uav1]` -> `uav1`."""
    return parameter.partition("[")[2].removesuffix("]")


def is_changed(effect: dict, member: str) -> bool:
    """Return whether an effect changes a member: an offset that may be 0 is none."""
    offset = effect["parameters"].get(f"offset_db[{member}]")
    return offset is None or not (offset["low"] or 0.0) <= 0.0 <= (offset["high"] or 0.0)


def is_sure(report: dict) -> bool:
    """Return whether each cause that was found has a probability of at least `MIN_SURE`.

    Steps between flights have none.
    """
    return not report["posterior"] or all(
        (each.get("probability") or 0.0) >= MIN_SURE for each in causes(report))


def rivals(report: dict) -> str:
    """Say how probable the causes are that were found, and what else the first one may be."""
    found_causes = causes(report)
    known = [each for each in found_causes if each.get("probability") is not None]
    found = [f"{name_label(each['name'])} {probability(each['probability'])}" for each in known]
    text = f"Probability that it is there: {join_names(found)}. " if found else ""
    first = next((rank for rank, each in enumerate(report["effects"], 1)
                  if each in found_causes), 0)
    # What acts on one flight comes before the steps of which rivals are known.
    step = next((each for each in report["posterior"] if each["step"] == first), None)
    if step is None or report["effects"][first - 1].get("probability") is None:
        return text
    named = {each["name"] for each in report["effects"]}
    others = {each["name"]: each["probability"] or 0.0 for each in step["probabilities"]
              if each["name"] not in named
              and not (each["name"] == NONE and report.get("anomalies"))}
    left = 1.0 - report["effects"][first - 1]["probability"]
    share = min(1.0, left / max(sum(others.values()), 1e-9))
    same = report["effects"][first - 1].get("indistinguishable_from", [])
    # A number would say that the data can tell them apart.
    likely = [f"{name_label(name)} (the data cannot tell them apart)" for name in same]
    likely += [f"{_cause(name)} {probability(share * each)}" for name, each in others.items()
               if share * each >= LIKELY and name not in same]
    return text + (f"What else it may be: {join_names(likely[:MAX_NAMED])}." if likely else "")


def undetectable(report: dict) -> str:
    """Say which effects would not have been named at any size that they may have; else empty."""
    names = [name_label(each["name"]) for each in report["detectable"] if each["size"] is None]
    return (f"Not to be seen in a typical form, at any size that they may have: "
            f"{join_names(names)}.") if names else ""


def with_quality(report: dict) -> str:
    """Say the error where each reading's own quality is known, which no map has; else empty."""
    known = report["error"].get("after_with_quality")
    if not known:
        return ""
    return (f"Where the quality of each reading is known, as on no map, it is "
            f"{number(known['rmse_db'])} dB.")


def side_by_side(report: dict) -> list[str]:
    """Say by how much receivers differ where both have been, the largest differences first."""
    return [_side_by_side(each) for each in _largest_first(report)]


def drivers(report: dict) -> list[str]:
    """Return labels of the variables that the residual depends on; if none, that of the base."""
    found = report["remaining"]["drivers"] or [
        each for each in report.get("dependences_before", []) if _counts(each, report)]
    return [variable_label(each["variable"])[0] for each in found[:MAX_NAMED]]


def is_reference(parameter: dict) -> bool:
    """Return whether a parameter is that of the member which the others are compared with.

    Others may be known exactly, and 0, such as where a building is that is gone.
    """
    known = parameter["value"] == parameter["low"] == parameter["high"] == 0
    return known and parameter.get("unit") == "dB"


def _criteria(report: dict) -> dict[str, float]:
    """Return the report's criteria, and today's in place of those that it lacks."""
    return vars(SelectionCriteria()) | report.get("criteria", {})


def _counts(dependence: dict, report: dict) -> bool:
    """Return whether a dependence meets the report's criteria."""
    criteria = _criteria(report)
    p_value, effect_db = dependence["p_value"], dependence.get("effect_db")
    return p_value is not None and p_value <= criteria["max_dependence_p_value"] and (
        effect_db is None or effect_db >= criteria["min_dependence_db"])


def causes(report: dict) -> list[dict]:
    """Return the effects that were found and explain something."""
    interpolated = interpolations()
    return [each for each in report["effects"]
            if each["name"] not in interpolated and not each.get("is_declared")]


def _has_interpolation(report: dict) -> bool:
    return not interpolations().isdisjoint(each["name"] for each in report["effects"])


def _largest_first(report: dict) -> list[dict]:
    return sorted(report.get("receivers_compared", []),
                  key=lambda each: -abs(each["difference_db"]["value"]))


def _differ(difference_db: dict) -> bool:
    surely = not difference_db["low"] <= 0 <= difference_db["high"]
    return surely and abs(difference_db["value"]) >= MIN_DIFFERENCE_DB


def _side_by_side(found: dict) -> str:
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
    """Return the RMSE after [dB], of the links that the RMSE before is of."""
    return (error.get("after_same_links") or error["after"]).get("rmse_db")


def _effect(report: dict) -> str:
    error = report["error"]
    without_cause = interpolations()
    explained = [each["heldout_rmse_db"] for each in report["candidates"]
                 if each["kept"] and each["name"] not in without_cause]
    interpolated = _has_interpolation(report)
    after = explained[-1] if explained and interpolated else rmse_after_db(error)
    found = causes(report)
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
    text = (f"{start}: {'; '.join(objects(report))}{sure}. With {it} the RMSE on held-out links "
            f"{goes}.")
    left = _unnamed_beside(report)
    if left is not None:
        text += (f" Beside {it} something is left that has no name (probability "
                 f"{probability(left)}).")
    if report["remaining"]["drivers"]:
        text += f" The remaining residual depends on {join_names(drivers(report))}."
    return text


def _unnamed_beside(report: dict) -> float | None:
    """Return how probable it is that something without a name is left; None where it is not."""
    found = report["posterior"][-1]["probabilities"] if report["posterior"] else []
    if not found or found[0]["name"] != OTHER:
        return None
    return found[0]["probability"] if (found[0]["probability"] or 0.0) >= HALF else None


def _none(report: dict) -> str:
    return " ".join(filter(None, [
        f"No group of links stands out, and no cause was found{_of(report, NONE)}.",
        seen_from(report), _sizes(report)]))


def _located(report: dict) -> str:
    return " ".join(filter(None, [
        f"The {_residual(report)}", _not_looked_for(report), _settled_by(report)]))


def _not_looked_for(report: dict) -> str:
    """Say which effects the data lack something for: one of them may be what is missing."""
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


def _residual(report: dict) -> str:
    names = drivers(report)
    depends = f" and depends on {join_names(names)}" if names else ""
    return f"residual is {number(report['error']['before']['rmse_db'])} dB RMSE{depends}."


def _undecided(report: dict) -> str:
    step = next(iter(report["posterior"]), None)
    if step is None:
        return "Undecided: no cause was looked for."
    likely, sizes = _likely(step["probabilities"], report), ""
    what = "whether that is real"
    if not report.get("anomalies"):
        what, sizes = "the cause", _sizes(report)
        none = next((each["probability"] or 0.0 for each in step["probabilities"]
                     if each["name"] == NONE), 0.0)
        if sizes and none >= HALF:
            sizes += " That much at places is not said to be nothing."
    return " ".join(filter(None, [
        f"Undecided: these measurements do not tell {what}.", likely and f"Likeliest: {likely}.",
        f"The {_residual(report)}", _not_looked_for(report), _settled_by(report), sizes]))


def _settled_by(report: dict) -> str:
    """Say what would settle which of the likeliest causes is there."""
    step = next(iter(report["posterior"]), None)
    if step is None:
        return ""
    names = [each["name"] for each in step["probabilities"] if (each["probability"] or 0) >= LIKELY]
    advice = list(filter(None, (_settles(name, step["step"], report) for name in names)))
    return f"To settle it: {'; '.join(dict.fromkeys(advice[:2]))}." if advice else ""


def _settles(name: str, step: int, report: dict) -> str:
    """Say what would settle whether an effect is there, and of which device or receiver.

    Of several forms of an effect, such as a device's antenna and a receiver's, that of the ends
    which it was looked for in. Empty where nothing is known.
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
        shown = ", ".join(names[:MAX_NAMED]) + " and others" * (len(names) > MAX_NAMED)
        who = f"{end}{'s' * (len(names) > 1)} {shown}"
        text = texts.get(end == "receiver", first)
        if end == "device" and len(names) == 1 and "the device" in text:
            return text.replace("the device", who)
        return f"{text} ({who})"
    return first


def _likely(probabilities: list[dict], report: dict) -> str:
    """Name what is likeliest, with probabilities; empty where nothing is likely.

    While a group stands out, it is not said that nothing is missing.
    """
    likely = [each for each in probabilities if (each["probability"] or 0) >= LIKELY
              and not (each["name"] == NONE and report.get("anomalies"))]
    return join_names([f"{_cause(each['name'])} ({probability(each['probability'])})"
                       for each in likely[:MAX_NAMED]])


def _of(report: dict, name: str) -> str:
    step = next(iter(report["posterior"]), None)
    found = {each["name"]: each["probability"] for each in step["probabilities"]} if step else {}
    return f" (probability {probability(found[name])})" if name in found else ""


def _sizes(report: dict) -> str:
    """Divide the error of the base between places and single readings; squares add up to it."""
    step = next(iter(report["posterior"]), None)
    whole_db = report["error"]["before"]["rmse_db"]
    if step is None or None in (step["rest_db"], step["noise_db"], whole_db):
        return ""
    alike = "errors of the map and its materials" if _has_map(report) else "shadowing"
    both_db = hypot(step["rest_db"], step["noise_db"])
    places_db, single_db = (whole_db * each / both_db if both_db else 0.0
                            for each in (step["rest_db"], step["noise_db"]))
    return (f"Of the base's {number(whole_db)} dB, roughly {number(places_db)} dB repeat at a "
            f"place ({alike}), and {number(single_db)} dB differ from reading to reading (squares "
            "add up).")


def _has_map(report: dict) -> bool:
    """Return whether a 3D map was given: without one, every link counts as one with sight."""
    hidden = report["error"].get("by_los", {}).get("nlos")
    given = (report.get("inputs") or {}).get("scene") or report["base"] == "raytrace"
    return bool(given or (hidden and hidden["before"]["n"]))


def _cause(name: str) -> str:
    return {NONE: "nothing is missing",
            OTHER: "something that is not in the catalogue"}.get(name, name_label(name))
