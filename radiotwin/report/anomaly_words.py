"""Put anomalies into words: which group of links differs from its peers, by how much, and why."""

from collections.abc import Collection, Sequence
from typing import Any

from radiotwin.closeloop.verdict.criteria import LIKELY, MIN_SURE
from radiotwin.closeloop.verdict.posterior import NONE, OTHER
from radiotwin.display import count
from radiotwin.effects.registry import effects_named
from radiotwin.io.forms import Origin
from radiotwin.io.texts import moment
from radiotwin.report.labels import (
    DATES_S,
    apart,
    join_names,
    name_label,
    origin_of,
    place_words,
    probability,
    signed,
    variable_label,
)

MAX_NAMED = 4  # members, causes or variables in a sentence
MAX_SENTENCES = 3  # of groups; the others are in the table
ANOTHER = "another"  # cause, which is not in the catalogue
ENDS = ("device", "receiver", "flight")
JOINED = {"receiver": "with", "flight": "on"}  # how an end follows another one
COUNTS = ("no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten",
          "eleven", "twelve")
SIGHT = {"los": "with line of sight", "nlos": "without line of sight"}
STATISTICS = {"level": "level", "scatter": "scatter", "blanks": "share of blanks",
              "curve": "change of level"}
ALONG = {"time_s": "in the course of time", "flight": "from flight to flight",
         "body_azimuth_deg": "with the direction of arrival", "predicted_db": "with the level"}
PEERS = {"device x flight": "on {its} other flights", "receiver x flight": "on {its} other flights",
         "device x receiver": "with {its} other receivers", "time": "in the rest of the time",
         "direction": "in other directions", "distance": "at other distances",
         "altitude": "at other heights", "level": "at other levels", "place": "elsewhere"}
OVER = {"flight": "on all flights", "direction": "in all directions"}
RANGES = {"azimuth_deg": "at azimuths", "elevation_deg": "at elevations",
          "body_azimuth_deg": "at directions of arrival", "distance_m": "at distances",
          "height_m": "at heights", "predicted_db": "at predicted levels"}


def where(report: dict) -> str:
    """Describe the anomalies of a close-loop with their likeliest causes; empty if there are none.

    An anomaly is a group of links that reads otherwise than its peers. Groups beyond
    `MAX_SENTENCES` are only counted.

    Args:
        report: content of `closeloop.json`.
    """
    anomalies = report.get("anomalies", [])
    text = [f"{sentence(each, report)} {causes_sentence(each, _named(index, report))}"
            for index, each in enumerate(anomalies[:MAX_SENTENCES])]
    left = len(anomalies) - MAX_SENTENCES
    if left > 0:
        text.append(f"{count(left, 'more group').capitalize()} stand{'s' * (left == 1)} out.")
    return " ".join(text)


def sentence(anomaly: dict, report: dict) -> str:
    """Say how a group of links differs from its peers: "Device d3 reads 5.6 dB less than …".

    The verb is preceded by "probably" if the group's probability is below `MIN_SURE`.
    """
    start, is_plural = group(anomaly, origin_of(report))
    maybe = "" if anomaly["probability"] >= MIN_SURE else "probably "
    over = [OVER[each] for each in anomaly.get("same_over", [])]
    everywhere = f", {join_names(over)}" if over else ""
    text = f"{maybe}{_predicate(anomaly, report, is_plural)}{everywhere}"
    return f"{start[0].upper()}{start[1:]} {text} ({probability(anomaly['probability'])})."


def causes_sentence(anomaly: dict, named: Sequence[dict]) -> str:
    """Name the causes of an anomaly: "Cause: …", or "Its cause is open: …" and the likeliest ones.

    Args:
        anomaly: entry of `anomalies`; its causes less probable than `LIKELY` are left out.
        named: effects in the final model that explain the anomaly; none: the cause is open.
    """
    found = [each for each in anomaly.get("causes", []) if (each["probability"] or 0) >= LIKELY]
    likely = {each["name"] for each in found}
    found = [*(each for each in named if each["name"] not in likely), *found]
    same = {each["name"]: each.get("indistinguishable_from", []) for each in named}
    start = "Cause" if named else "Its cause is open"
    words = "; ".join(" or ".join(cause(name, anomaly["members"]) for name in (
        each["name"], *same.get(each["name"], []))) + (
            "" if each["probability"] is None else f" ({probability(each['probability'])})")
        for each in found[:MAX_NAMED])
    return f"{start}: {words}." if words else f"{start}."


def _named(index: int, report: dict) -> list[dict]:
    """Return the effects of a report that explain the anomaly with this index."""
    return [each for each in report["effects"] if index in each.get("anomalies", [])]


def cause(name: str, members: Collection[str]) -> str:
    """Describe a cause in words; some causes are called differently at a receiver and a device.

    Args:
        name: of the effect, or of a hypothesis such as `another` cause.
        members: kinds of members that the anomaly names, of `device`, `receiver`, `flight`.
    """
    if name in (ANOTHER, OTHER):
        return "another cause"
    if name == NONE:
        return "nothing is missing"
    forms, of_receiver = effects_named(name), "receiver" in members
    if of_receiver != ("device" in members):  # words for that end
        forms = [each for each in forms if each.of_receiver == of_receiver] or forms
    words = [each.in_words for each in forms if each.in_words]
    return " or ".join(dict.fromkeys(words)) or name_label(name)


def group(anomaly: dict, origin: Origin | None = None) -> tuple[str, bool]:
    """Describe the links of an anomaly: "device d3 on flight f2"; also return if that is plural.

    `anomaly` is an entry of `anomalies` in `closeloop.json`. A device, receiver and flight with
    exactly the same links are joined by "or". A place is in latitude and longitude if the origin of
    the local frame is known, else x and y [m].
    """
    members = {end: names for end in ENDS if (names := anomaly["members"].get(end))}
    text = ""
    same_links = anomaly["family"] in ENDS and len(members) > 1
    for end, names in members.items():
        joined = (" or " if same_links else f" {JOINED[end]} ") if text else ""
        text += f"{joined}{end}{'s' * (len(names) > 1)} "
        text += some_names([apart(end, name) for name in names])
    text += " (they never part)" * same_links
    is_plural = bool(members) and len(next(iter(members.values()))) > 1
    los_words = SIGHT.get(anomaly.get("sight", "all"), "")
    if not members:
        text, is_plural = f"links {los_words}".rstrip(), True
    elif los_words:
        text += f" ({los_words})"
    ranges = [_range(name, *ends, origin=origin) for name, ends in _ranges(anomaly)]
    return " ".join([text, *ranges]), is_plural


def rows(report: dict) -> list[list[str]]:
    """Return a table row for each anomaly: group, causes, statistic, size, interval, …."""
    found = []
    for index, each in enumerate(report.get("anomalies", [])):
        why = causes_sentence(each, _named(index, report)).partition(": ")[2].removesuffix(".")
        found.append([
            group(each, origin_of(report))[0], why or "open", statistic(each), size(each),
            interval(each["size"]), probability(each["probability"]), f"{each['links']:,}"])
    return found


def statistic(anomaly: dict) -> str:
    """Return the compared statistic in words, such as "change of level in the course of time"."""
    along = ALONG.get(anomaly.get("along", ""), "")
    return f"{STATISTICS[anomaly['statistic']]} {along}".rstrip()


COLUMNS = ("group", "possible causes", "statistic", "against its peers", "90 % interval",
           "probability", "links")


def seen_from(report: dict) -> str:
    """Say how many dB off a device, receiver or flight would have been found; empty if unknown."""
    found = [f"a {each['family']} that is {each['size']:.1f} dB off"
             for each in report.get("seen_from", [])
             if each["family"] in ENDS and each["statistic"] == "level"]
    return f"This would have been seen: {join_names(found)}, or more." if found else ""


def seen_rows(report: dict) -> list[list[str]]:
    """Return the smallest deviations that would be found, a row for each family of groups.

    Columns: family (such as device), level, scatter, and share of readings that are blank.
    """
    sizes: dict[str, dict[str, str]] = {}
    for each in report.get("seen_from", []):
        sizes.setdefault(each["family"], {})[each["statistic"]] = size({"size": each | {
            "value": each["size"]}}).removeprefix("+")
    return [[family, *(each.get(statistic, "–") for statistic in ("level", "scatter", "blanks"))]
            for family, each in sizes.items()]


def size(anomaly: dict) -> str:
    """Return the deviation of an anomaly from its peers, with its unit; a dash if not known."""
    found = anomaly["size"]
    value, unit = found["value"], found["unit"]
    if value is None:
        return "–"
    if unit == "share":
        return f"{'+' * (value > 0)}{signed(100 * value, 0)} %"
    if unit == "times":
        return f"{value:.1f} times"
    if anomaly.get("statistic") == "curve":
        return f"{value:.1f} {unit} RMS"
    return f"{'+' * (value > 0)}{signed(value)} {unit}"


def interval(found: dict) -> str:
    """Return the 90 % interval of an anomaly's deviation, without unit; a share in percent."""
    low, high = found["low"], found["high"]
    if None in (low, high):
        return "–"
    if found["unit"] == "share":
        return f"{signed(100 * low, 0)} to {signed(100 * high, 0)}"
    if found["unit"] == "times":
        return f"{low:.1f} to {high:.1f}"
    return f"{signed(low)} to {signed(high)}"


def _predicate(anomaly: dict, report: dict, is_plural: bool) -> str:
    """Say how a group deviates: "reads 5.6 dB (5.1 to 6.1) less than the seven others"."""
    found, peers = anomaly["size"], _peers(anomaly, report, is_plural)
    value, s = found["value"] or 0.0, "" if is_plural else "s"  # ending of the verb
    is_less = value < 0
    more = "less" if is_less else "more"
    # An amount is told without its sign, and so is its interval.
    low, high = found["low"], found["high"]
    if None not in (low, high) and is_less and found["unit"] != "times":
        low, high = -high, -low
    amount = abs(value)
    if anomaly["statistic"] == "scatter":
        return f"scatter{s} {amount:.1f} times{_in_brackets(low, high)} as much as {peers}"
    if anomaly["statistic"] == "blanks":
        low, high = (None if each is None else 100 * each for each in (low, high))
        blank = "are" if is_plural else "is"
        return (f"{blank} blank on {100 * amount:.0f} %{_in_brackets(low, high, 0)} {more} of "
                f"{'their' if is_plural else 'its'} links than {peers}")
    if anomaly["statistic"] == "curve":
        along = ALONG[anomaly["along"]]
        return (f"change{s} by {amount:.1f} dB RMS{_in_brackets(low, high)} {along}, more than "
                f"{peers}")
    return f"read{s} {amount:.1f} dB{_in_brackets(low, high)} {more} than {peers}"


def _peers(anomaly: dict, report: dict, is_plural: bool) -> str:
    """Name the peers of an anomaly, such as "the seven others": those with held-out links."""
    family = anomaly["family"]
    if family in PEERS:
        return PEERS[family].format(its="their" if is_plural else "its")
    groups = report["error"].get(f"by_{family}") or {}
    known = {name for name, both in groups.items() if both["before"]["n"]}
    others = len(known - set(anomaly["members"].get(family, ())))
    if others == 1:
        return f"the other {family}"
    return f"the {COUNTS[others] if 1 < others < len(COUNTS) else others} others" \
        if others > 0 else f"other {family}s"


def _in_brackets(low: float | None, high: float | None, digits: int = 1) -> str:
    """Return an interval in brackets, with a space before; empty if it is not known."""
    if low is None or high is None:
        return ""
    return f" ({signed(low, digits)} to {signed(high, digits)})"


def _ranges(anomaly: dict) -> list[tuple[str, Sequence[float | None]]]:
    """Return name and limits of each range of an anomaly; x and y are joined to one, `place`."""
    ranges = dict(anomaly.get("ranges") or {})
    found = []
    if "x_m" in ranges and "y_m" in ranges:
        found.append(("place", [*ranges.pop("x_m"), *ranges.pop("y_m")]))
    return [*found, *ranges.items()]


def _range(name: str, *ends: Any, origin: Origin | None) -> str:
    """Put a range into words: "at distances of 100 to 300 m"; None: open at that end."""
    if name == "place" and origin:
        west_m, east_m, south_m, north_m = ends
        middle = place_words((west_m + east_m) / 2, (south_m + north_m) / 2, origin)
        return f"at or through {east_m - west_m:.0f} by {north_m - south_m:.0f} m about {middle}"
    if name == "place":
        west, east, south, north = (_rounded(each) for each in ends)
        return f"at or through x {west} to {east} m, y {south} to {north} m"
    low, high = ends
    if name == "time_s":
        return _times(low, high)
    label, unit = variable_label(name)
    start = RANGES.get(name, f"at {label}")
    unit = unit.partition(" ")[0]
    if unit == "°":
        if "azimuth" in name or "heading" in name:
            low, high = (None if each is None else each % 360 for each in (low, high))
        return f"{start} of {_rounded(low)}° to {_rounded(high)}°"
    if low is None or high is None:
        beyond = f"up to {_rounded(high)}" if low is None else f"from {_rounded(low)}"
        return f"{start} {beyond} {unit}"
    return f"{start} of {_rounded(low)} to {_rounded(high)} {unit}"


def _times(low: float | None, high: float | None) -> str:
    """Put a range of times [s] into words; times since 1970 are dates, None is an open end."""
    ends = [None if each is None else
            moment(each) if DATES_S[0] < each < DATES_S[1] else f"{_rounded(each)} s"
            for each in (low, high)]
    words = [f"{word} {each}" for word, each in zip(("from", "to"), ends) if each is not None]
    return " ".join(words)


def some_names(names: Sequence[str]) -> str:
    """Join the first `MAX_NAMED` names, and count the others."""
    left = len(names) - MAX_NAMED
    if left <= 1:
        return join_names(list(names))
    return f"{', '.join(names[:MAX_NAMED])} and {left:,} others"


def _rounded(value: float | None) -> str:
    """Round a number to an integer."""
    return "–" if value is None else signed(value, 0)
