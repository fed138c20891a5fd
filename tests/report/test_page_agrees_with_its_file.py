"""Each number of a close-loop's summary is in its `closeloop.json`, and no two statements contradict each other."""

import html
import json
import re
from itertools import chain
from math import hypot
from pathlib import Path

import pytest

from radiotwin.report import anomaly_words
from radiotwin.report.closeloop_page import closeloop_context, write_closeloop_page
from radiotwin.report.closeloop_words import closeloop_summary
from radiotwin.report.labels import name_label
from tests.report.test_closeloop_page import DRIFT, LOW, SCORES, report

SAMPLE = Path(__file__).parents[1] / "closeloop" / "sample" / "closeloop.json"
NUMBER = r"−?\d[\d,]*\.?\d*"
LIKELY = 0.05


def anomaly(family, members, statistic, value, low, high, unit, **others):
    size = {"value": value, "low": low, "high": high, "unit": unit}
    return LOW | {"family": family, "members": members, "statistic": statistic, "size": size} | others


GROUPS = [
    (LOW | {"same_over": ["flight", "direction"]},
     "Device d3 reads 5.6 dB (5.1 to 6.1) less than the seven others, on all flights and in all directions (0.99)."),
    (LOW | {"sight": "los", "probability": 0.7},
     "Device d3 (with line of sight) probably reads 5.6 dB (5.1 to 6.1) less than the seven others (0.70)."),
    (anomaly("device", {"device": ["d3"], "receiver": ["u1"]}, "level", -5.6, -6.1, -5.1, "dB"),
     "Device d3 or receiver u1 (they never part) reads 5.6 dB (5.1 to 6.1) less than the seven others (0.99)."),
    (anomaly("flight", {"flight": ["f2"]}, "scatter", 4.2, 3.84, 4.6, "times"),
     "Flight f2 scatters 4.2 times (3.8 to 4.6) as much as the four others (0.99)."),
    (anomaly("receiver", {"receiver": ["u0"]}, "blanks", 0.32, 0.28, 0.36, "share"),
     "Receiver u0 is blank on 32 % (28 to 36) more of its links than the other receiver (0.99)."),
    (anomaly("receiver", {"receiver": ["u0"]}, "curve", 1.7, 1.1, 2.4, "dB", along="time_s"),
     "Receiver u0 changes by 1.7 dB RMS (1.1 to 2.4) in the course of time, more than the other receiver (0.99)."),
    (anomaly("device x flight", {"device": ["d3"], "flight": ["f3", "f4"]}, "scatter", 3.0, 2.5, 3.5, "times"),
     "Device d3 on flights f3 and f4 scatters 3.0 times (2.5 to 3.5) as much as on its other flights (0.99)."),
    (anomaly("device x receiver", {"device": ["d3"], "receiver": ["u1"]}, "level", 3.2, 2.0, 4.4, "dB"),
     "Device d3 with receiver u1 reads 3.2 dB (2.0 to 4.4) more than with its other receivers (0.99)."),
    (anomaly("time", {"receiver": ["u1"], "flight": ["f1"]}, "level", -3.0, -4.0, -2.0, "dB",
             ranges={"time_s": [120.0, 300.0]}),
     "Receiver u1 on flight f1 from 120 s to 300 s reads 3.0 dB (2.0 to 4.0) less than in the rest of the time (0.99)."),
    (anomaly("direction", {"device": ["d3"]}, "level", -9.0, -10.0, -8.0, "dB", ranges={"azimuth_deg": [337.5, 382.5]}),
     "Device d3 at azimuths of 338° to 22° reads 9.0 dB (8.0 to 10.0) less than in other directions (0.99)."),
    (anomaly("distance", {}, "level", -2.0, -2.5, -1.5, "dB", ranges={"distance_m": [100.0, 300.0]}, sight="nlos"),
     "Links without line of sight at distances of 100 to 300 m read 2.0 dB (1.5 to 2.5) less than at other distances (0.99)."),
    (anomaly("place", {}, "level", -12.0, -13.0, -11.0, "dB", ranges={"x_m": [-100.0, 0.0], "y_m": [50.0, 150.0]}),
     "Links at or through x −100 to 0 m, y 50 to 150 m read 12.0 dB (11.0 to 13.0) less than elsewhere (0.99)."),
    (anomaly("device", {"device": [f"d{i}" for i in range(6)]}, "level", 2.0, 1.0, 3.0, "dB"),
     "Devices d0, d1, d2, d3 and 2 others read 2.0 dB (1.0 to 3.0) more than the two others (0.99).")]


def with_members(verdict, anomalies=(), **changes):
    content = report(verdict, anomalies=list(anomalies), **changes)
    both = {"before": SCORES, "after": content["error"]["after"]}
    content["error"] |= {"by_device": {f"d{i}": both for i in range(8)}, "by_receiver": {"u0": both, "u1": both},
                         "by_flight": {f"f{i}": both for i in range(5)}}
    return content


def _reports():
    """Reports of several kinds."""
    effect = [DRIFT | {"probability": 0.83, "anomalies": [0], "size_db": LOW["size"]}]
    yield with_members("effect", [LOW], effects=effect)
    yield with_members("effect")
    known = with_members("effect", effects=[DRIFT | {"name": "unexplained_trend"}, *effect])
    known["error"]["after_with_quality"] = SCORES | {"rmse_db": 1.37}
    yield known
    for group, _ in GROUPS:
        yield with_members("located", [group])
    yield with_members("located", [group for group, _ in GROUPS])
    yield with_members("undecided", [LOW | {"probability": 0.6}])
    yield with_members("undecided")
    yield with_members("none", seen_from=[
        {"family": family, "statistic": statistic, "size": each, "unit": unit} for family, statistic, each, unit in (
            ("device", "level", 1.83, "dB"), ("receiver", "level", 1.2, "dB"), ("device", "scatter", 2.1, "times"),
            ("place", "blanks", 0.31, "share"))])
    yield json.loads(SAMPLE.read_text(encoding="utf-8"))


def shown(value):
    """Every way in which a page may show a number, without its sign."""
    value = abs(value)
    return {f"{value:,.{digits}f}" for digits in (0, 1, 2)} | {f"{value:.2g}", f"{100 * value:.0f}", f"{value % 360:.0f}"}


def numbers(content):
    if isinstance(content, dict):
        return set(chain.from_iterable(map(numbers, content.values())))
    if isinstance(content, list):
        return set(chain.from_iterable(map(numbers, content))) | {str(len(content))}
    return shown(content) if isinstance(content, int | float) else set()


def known_numbers(content):
    """Numbers of a file, those that follow from it, and those that belong to words."""
    found = numbers(content)
    for step in content["posterior"]:
        whole_db, parts_db = content["error"]["before"]["rmse_db"], (step["rest_db"], step["noise_db"])
        found |= set().union(*(shown(whole_db * each / hypot(*parts_db)) for each in parts_db))
    for effect in content["effects"]:  # a rival's share of what is left
        left = 1 - (effect.get("probability") or 1.0)
        found |= set().union(*(shown(left * share["probability"] / total) for step in content["posterior"]
                               for share in step["probabilities"]
                               for total in (1.0, *_sums(step["probabilities"]))))
    return found | {"0.99", "0.01", "90"} | {str(each) for each in range(13)}


def _sums(probabilities):
    """Return what all probabilities of a step sum to, with and without that of nothing."""
    return [sum(each["probability"] for each in probabilities if each["name"] not in left_out) for left_out in ((), ("none",))]


def summary(content):
    """Text of the summary of a page without names: lead, rivals, cards and table of groups."""
    context = closeloop_context(content, Path("no-such-folder"))
    cards = [value for _, value in context["cards"]]
    rows = [cell for table in ("anomalies", "seen_from") for row in context[table].rows for cell in row]
    text = " ".join([context["lead"], *context["more"], context["rivals"], *cards, *rows])
    advice = (content.get("prediction") or {}).get("advice", "")
    text = text.replace(advice, "") if advice else text
    return re.sub(r"\b[a-z]\d\b|P\.\d+|\(\d+ times\)", "", text)


def unknown_numbers(text, content):
    known = known_numbers(content)
    return [each for each in re.findall(NUMBER, text) if each.rstrip(".,").lstrip("−") not in known]


def contradictions(content, text):
    """Return what a page says of one thing in two ways."""
    found = []
    anomalies = content.get("anomalies", [])
    if anomalies and "nothing is missing" in text:
        found.append("nothing is missing beside a group")
    if bool(anomalies) == ("No group of links stands out" in text or "nothing stands out" in text) and \
            (anomalies or content["verdict"] == "none"):
        found.append("groups")
    said = {each["name"] for each in content["effects"]} | {
        each["name"] for step in content["posterior"] for each in step["probabilities"]
        if (each["probability"] or 0) >= LIKELY} | {
        each["name"] for group in anomalies for each in group["causes"] if each["probability"] >= LIKELY}
    unseen = re.search(r"Not to be seen in a typical form[^:]*: ([^.]*)\.", text)
    found += [name for name in said if unseen and name_label(name) in unseen[1]]
    return found


@pytest.mark.parametrize("content", list(_reports()), ids=lambda each: each["verdict"])
def test_a_page_agrees_with_its_file(content, tmp_path):
    assert unknown_numbers(summary(content), content) == []
    write_closeloop_page(content, tmp_path, "page")
    text = html.unescape(re.sub(r"<[^>]+>", " ", (tmp_path / "closeloop.html").read_text(encoding="utf-8")))
    assert contradictions(content, text) == []
    for group in content["anomalies"]:
        if group in content["anomalies"][:anomaly_words.MAX_SENTENCES]:
            assert anomaly_words.sentence(group, content) in text


@pytest.mark.parametrize(("group", "sentence"), GROUPS, ids=lambda each: each["family"] if isinstance(each, dict) else "")
def test_each_kind_of_group_is_said_in_plain_words(group, sentence):
    assert anomaly_words.sentence(group, with_members("located", [group])) == sentence


def test_a_place_is_in_latitude_and_longitude_where_the_origin_is_known():
    place = next(group for group, _ in GROUPS if group["family"] == "place")
    content = with_members("located", [place], inputs={"origin": {"latitude_deg": 47.0, "longitude_deg": 8.0}})
    words = "inks at or through 100 by 100 m about 47.00090° N, 7.99934° E"
    assert words in anomaly_words.sentence(place, content) and words in anomaly_words.rows(content)[0][0]


def test_what_was_found_comes_first_and_a_named_cause_is_told_from_an_open_one():
    named = with_members("effect", [LOW], effects=[DRIFT | {"name": "device_gain_offset", "probability": 0.95, "anomalies": [0],
                                                             "indistinguishable_from": []}])
    text = closeloop_summary(named)
    assert text.startswith("Found: power, cable or antenna of r<0>. With it ")
    assert text.endswith("Device d3 reads 5.6 dB (5.1 to 6.1) less than the seven others (0.99). Cause: power, cable or "
                         "antenna of the device (0.70); vegetation (0.25).")
    either = named["effects"][0] | {"indistinguishable_from": ["receiver_gain_offset"]}
    assert "Cause: power, cable or antenna of the device or gain, cable or antenna of the receiver (0.70);" \
        in closeloop_summary(named | {"effects": [either]})
    assert "Its cause is open: power" in closeloop_summary(with_members("located", [LOW]))
    many = closeloop_summary(with_members("located", [group for group, _ in GROUPS]))
    assert "10 more groups stand out." in many


@pytest.mark.parametrize(("name", "members", "words"), (
    ("antenna_pattern", {"device": ["d3"]}, "directions of the device's antenna"),
    ("antenna_pattern", {"receiver": ["u1"]}, "tilt of the receiver's antenna"),
    ("antenna_pattern", {}, "directions of the device's antenna or tilt of the receiver's antenna"),
    ("another", {}, "another cause"), ("of_a_plugin_that_is_gone", {}, "of a plugin that is gone")))
def test_a_cause_is_called_what_it_is_at_that_end(name, members, words):
    assert anomaly_words.cause(name, members) == words
