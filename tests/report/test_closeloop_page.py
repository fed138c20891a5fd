"""The page of a close-loop: right for each verdict, and never stopped by what a file may hold."""

import os
import re
from io import BytesIO

import pytest
from matplotlib.figure import Figure

from radiotwin.cli import model as loop
from radiotwin.errors import BadInput
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.closeloop_words import closeloop_summary, drivers, rivals
from radiotwin.report.labels import (
    parameter_number,
)

SCORES = {"n": 900, "bias_db": 0.04, "std_db": 3.0, "correlation": 0.9, "rmse_db": 3.0, "mae_db": 2.2, "nll": 2.5}
NOTHING = {"n": 0} | dict.fromkeys(["bias_db", "std_db", "correlation", "rmse_db", "mae_db", "nll"])
DRIFT = {"name": "receiver_drift", "variant": "", "rank": 1, "params": {}, "confused_with": ["interference"],
         "indistinguishable_from": ["receiver_gain_offset"],
         "parameters": {"step_db[r<0>]": {"value": -6.0, "low": -6.5, "high": -5.5, "unit": "dB"},
                        "step_time_s[r<0>]": {"value": 500.0, "low": None, "high": None, "unit": "s"}},
         "evidence": {"heldout_nll_gain": 210.0}}


LOW = {"family": "device", "members": {"device": ["d3"]}, "sight": "all", "statistic": "level", "probability": 0.99,
       "size": {"value": -5.6, "low": -6.1, "high": -5.1, "unit": "dB"}, "links": 461,
       "causes": [{"name": "device_gain_offset", "probability": 0.7}, {"name": "foliage", "probability": 0.25}]}


def report(verdict="effect", **changes):
    """The content of a `closeloop.json`."""
    found = verdict == "effect"
    after = SCORES | {"rmse_db": 2.0, "std_db": 2.0} if found else SCORES
    drivers = [{"variable": "time_in_flight_s", "p_value": 0.0004, "effect_db": 1.5}]
    return {
        "schema": "radiotwin.closeloop/3", "radiotwin_version": "0", "base": "twin", "verdict": verdict,
        "effects": [DRIFT | {"probability": 0.95}] if found else [],
        "candidates": [{"name": "receiver_drift", "step": 1, "heldout_rmse_db": 2.0, "heldout_nll_gain": 210.0,
                        "kept": found, "reason": "" if found else "gains nothing"},
                       {"name": "foliage", "step": 1, "heldout_rmse_db": None, "heldout_nll_gain": None,
                        "kept": False, "reason": "nothing in the residual looks like it"}],
        "heldout": {"by": "flight", "folds": 6, "n": 900},
        "error": {"before": SCORES, "after": after, "noise_floor_db": None,
                  "by_device": {"<b>": {"before": SCORES, "after": after},
                                "d1": {"before": NOTHING, "after": NOTHING}}},
        "baselines": {"log_distance": SCORES | {"rmse_db": 7.0},
                      "regression_kriging": {"rmse_db": 5.5, "median_db": 1}},
        "dependences_before": drivers,
        "remaining": {"structured": verdict == "located", "drivers": drivers if verdict == "located" else []},
        "posterior": [{"step": 1, "unnamed_nats": {"time": 12.0},
                       "rest_db": 3.5 if verdict == "located" else 2.5, "noise_db": 1.25, "probabilities": [
            {"name": "none", "probability": 0.705}, {"name": "antenna_pattern", "probability": 0.29},
            {"name": "not in the catalogue", "probability": 0.005}]}],
        "detectable": [{"name": "excess_attenuation", "size": 4.2, "unit": "dB/km", "pattern": "on all links"}],
        "anomalies": [LOW] if verdict == "located" else [], "notes": ["receiver <i> has 3 only"]} | changes


def page(content, folder):
    write_closeloop_page(content, folder, "Close-loop of <x>")
    return (folder / "closeloop.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("verdict, sentence, badge", [
    ("effect", "Found: gain of r&lt;0&gt; that changes with time. With it the RMSE on held-out links falls from 3.00 to 2.00 dB",
     "found: receiver drift"),
    ("none", "No group of links stands out, and no cause was found (probability 0.70).", "nothing stands out"),
    ("undecided", "Undecided: these measurements do not tell the cause. Likeliest: nothing is missing (0.70) and antenna pattern "
     "(0.29). The residual is 3.00 dB RMSE and depends on time in flight. To settle it: fly around the device at one distance and "
     "one height. Of the base&#39;s 3.00 dB, roughly 2.68 dB repeat at a place (shadowing), and 1.34 dB differ from reading to "
     "reading (squares add up). That much at places is not said to be nothing.", "undecided"),
    ("located",
     "Device d3 reads 5.6 dB (5.1 to 6.1) less than the other device (0.99). Its cause is open: power, cable or antenna of the "
     "device (0.70); vegetation (0.25).</p>\n<p>The residual is 3.00 dB RMSE and depends on time in flight.",
     "located: device d3; cause open")])
def test_each_verdict_is_told_first(tmp_path, verdict, sentence, badge):
    text = page(report(verdict), tmp_path)
    assert sentence in text and f"<dd>{badge}</dd>" in text and text.count("<dt>") <= 4
    assert text.index(sentence) < text.index("<h2>")
    assert not re.search(r'(src|href)="(?!data:)|https?://|<script', text)  # one file, no network


@pytest.mark.parametrize("ends, sentence", [
    ({"devices": ["n3"]}, "fly around device n3 at one distance"),
    ({"devices": ["n3", "n4"]}, "fly around the device at one distance and one height (devices n3, n4)."),
    ({"receivers": ["uav0"]}, "fly the same track in both directions (receiver uav0).")])
def test_what_would_settle_it_names_the_end(tmp_path, ends, sentence):
    tried = report()["candidates"][0] | {"name": "antenna_pattern", "variant": "of some kind", "probability": 0.4, "kept": False}
    found = report("undecided", candidates=[tried, tried | ends | {"probability": 0.45}])
    assert f"To settle it: {sentence}" in closeloop_summary(found)
    assert "antenna pattern: of some kind</td>" in page(found, tmp_path)


def test_only_what_meets_the_criteria_is_said_to_matter():
    chance, weak, strong = ({"variable": name, "p_value": p_value, "effect_db": effect_db} for name, p_value, effect_db in (
        ("distance_m", 1.0, 2.0), ("altitude_m", 0.001, 0.1), ("time_in_flight_s", 0.001, 1.5)))
    nothing = {"remaining": {"structured": False, "drivers": []}}
    found = report("located", dependences_before=[chance, weak, strong], **nothing)
    assert drivers(found) == ["time in flight"]
    assert "3.00 dB RMSE and depends on time in flight." in closeloop_summary(found)
    assert drivers(found | {"criteria": {"max_dependence_p_value": 1.0, "min_dependence_db": 1.0}}) == [
        "distance", "time in flight"]
    without = closeloop_summary(report("located", dependences_before=[chance, weak], **nothing))
    assert "3.00 dB RMSE. To settle" in without and "depends" not in without


def test_names_from_the_data_are_no_markup(tmp_path):
    text = page(report(), tmp_path)
    for written in ("device &lt;b&gt;", "step (r&lt;0&gt;)", "receiver &lt;i&gt; has 3 only",
                    "Close-loop of &lt;x&gt;"):
        assert written in text
    assert "<i>" not in text and "<x>" not in text


def test_the_figures_that_planners_judge_by_stand_in_one_table_with_the_other_models(tmp_path):
    text = page(report(), tmp_path)
    table = text[text.index("Error before and after"):text.index("by device, receiver and flight")]
    assert "2 trials in 1 step<" in text
    for words in ("bias [dB]", "standard deviation [dB]", "correlation", "log-distance law", "7.00",
                  "kriging", "5.50", "median db"):
        assert words in table


def test_what_an_effect_may_be_taken_for_is_said(tmp_path):
    text = page(report(), tmp_path)
    assert "The data cannot distinguish it from receiver gain offset." in text
    assert "Effects that may look alike: interference." in text
    assert "−6.50 to −5.50" in text
    assert "nothing in the residual looks like it" in text


@pytest.mark.parametrize("value, text", [(0.0, "0.00"), (0.003, "0.003"), (-0.00214, "−0.0021"), (0.07, "0.07"),
                                         (-6.5, "−6.50"), (12345.6, "12,346"), (3, "3"), (None, "–")])
def test_no_parameter_is_rounded_to_nothing(value, text):
    assert parameter_number(value) == text


def test_only_a_level_of_0_db_is_what_others_are_compared_with(tmp_path):
    parameters = {"offset_db[r0]": {"value": 0.0, "low": 0.0, "high": 0.0, "unit": "dB"},
                  "x_m": {"value": 0.0, "low": 0.0, "high": 0.0, "unit": "m"}}
    text = page(report(effects=[DRIFT | {"parameters": parameters}]), tmp_path)
    assert text.count("0 (reference)") == 1


def test_how_probable_it_is_and_what_would_have_been_seen_is_said(tmp_path):
    text = page(report(effects=[DRIFT | {"probability": 0.6, "size_db": {
        "value": 4.0, "low": 3.0, "high": 5.0, "unit": "dB", "determined": True}}]), tmp_path)
    assert "Probability that it is there: receiver drift 0.60." in text
    assert "What else it may be: receiver gain offset (the data cannot tell them apart), nothing is missing 0.28 and antenna " \
        "pattern 0.12." in text  # 0.4 are left
    assert "by 4.00 dB (RMS; 90 % interval 3.00 to 5.00)" in text
    assert "would have been named from" in text and "4.2 dB/km" in text
    nothing = {"value": None, "low": None, "high": None, "unit": "dB", "determined": False}
    blanks = page(report(effects=[DRIFT | {"size_db": nothing}]), tmp_path)
    assert "It changes no level, only which links are blank." in blanks
    assert "by – dB" not in blanks
    assert "repeat at a place" in closeloop_summary(report("none"))


@pytest.mark.parametrize("ends, sentence, in_lead", [
    ((-4.0, -4.8, -3.1), "A reads 4.00 dB (3.10 to 4.80) more than B", True),
    ((2.7, 0.4, 4.9), "B reads 2.70 dB (0.40 to 4.90) more than A", True),
    ((0.4, 0.1, 0.7), "B reads 0.40 dB (0.10 to 0.70) more than A", False),
    ((0.2, -0.5, 0.9), "A and B show no difference (−0.50 to 0.90 dB)", False)])
def test_receivers_that_were_at_the_same_places_are_compared(tmp_path, ends, sentence, in_lead):
    difference_db = dict(zip(("value", "low", "high"), ends), unit="dB")
    content = report(receivers_compared=[
        {"first": "A", "second": "B", "difference_db": difference_db, "pairs": 1234, "places": 56}])
    sentence += " where both were, within metres: 1,234 pairs of readings at 56 places"
    assert f"<li>{sentence}</li>" in page(content, tmp_path)
    assert (sentence in closeloop_summary(content)) == in_lead


def test_the_member_that_others_are_compared_with_is_marked_and_no_table_is_empty(tmp_path, monkeypatch):
    offsets = {f"offset_db[{name}]": {"value": value, "low": value - width, "high": value + width, "unit": "dB"}
               for name, value, width in (("a", 0.0, 0.0), ("b", 3.0, 0.5))}
    found = report(effects=[DRIFT | {"name": "receiver_gain_offset", "probability": 0.9, "parameters": offsets}])
    text = page(found, tmp_path)
    assert re.search(r"offset \(a\)</td><td>0 \(reference\)</td><td>–</td>", text)
    assert not re.search(r"</th></tr>\s*</table>", page(report(effects=[DRIFT | {"parameters": {}, "probability": 0.9}]), tmp_path))
    printed = {}
    monkeypatch.setattr(loop, "print_rows", lambda title, columns, rows: printed.update({title: rows}))
    error = {"error": report()["error"] | {"by_los": {}}, "baselines": {}}
    loop._print(found | error)
    assert [row[2] for row in printed["Added to the base"]] == ["reference", 3.0]
    printed.clear()
    loop._print(report("none") | error)
    assert len(printed) == 1  # of errors
    printed.clear()
    vague = {"x_m": {"value": -1.4, "low": -139.0, "high": 136.0, "unit": "dB", "determined": False}}
    known = {"error": error["error"] | {"after_with_quality": SCORES | {"rmse_db": 1.0}}, "baselines": {}}
    loop._print(report("located", effects=[DRIFT | {"parameters": vague}]) | known)
    groups, errors, added = printed.values()
    assert [[row[0], *row[2:5]] for row in groups] == [["device d3", "level", "−5.6 dB", "−6.1 to −5.1"]]
    assert [row[1:4] for row in errors] == [["before", "900", 3.0], ["after", "900", 2.0], ["after, with each reading's own quality", "900", 1.0]]
    assert added[0][2] == "not determined" and added[0][3] != added[0][3]


def test_numbers_that_are_not_known_are_dashes(tmp_path):
    unknown = report("none", baselines={"log_distance": NOTHING}, dependences_before=[])
    unknown["error"] |= {"before": NOTHING, "after": NOTHING}
    assert "no cause was found" in closeloop_summary(unknown)
    assert "None" not in page(unknown, tmp_path) and "nan" not in page(unknown, tmp_path)


BUILDING = {"name": "missing_obstacle", "parameters": {
    f"{name}_m": {"value": value, "low": value - 1, "high": value + 1, "unit": "m"}
    for name, value in (("x", 59.3), ("y", 1.2), ("length", 33.0), ("width", 37.5), ("height", 37.9))},
    "places": [{"x_m": 59.3, "y_m": 1.2, "outline_m": [[40, -20], [80, -20], [80, 20], [40, -20]]}]}
SECTOR = {"name": "antenna_pattern", "variant": "sector antenna of a device", "parameters": {
    "azimuth_deg[C]": {"value": 480.0, "low": 470.0, "high": 490.0, "unit": "deg"},
    "beamwidth_deg[C]": {"value": 90.0, "low": 80.0, "high": 100.0, "unit": "deg"}},
    "places": [{"device": "C", "x_m": -59.3, "y_m": 1.2}]}
OFFSETS = {"name": "device_gain_offset", "parameters": {
    f"offset_db[{name}]": {"value": value, "low": value - 1, "high": value + 1, "unit": "dB"}
    for name, value in (("a", -0.2), ("b", -6.8))}, "places": [{"device": name, "x_m": 0, "y_m": 0} for name in "ab"]}


@pytest.mark.parametrize("found, sentence", [
    (BUILDING, "a building that the map lacks, 33 by 38 m, 38 m high, at 47.05001° N, 8.30078° E."),
    (SECTOR, "sector antenna of C, 90° wide, towards 120°, at 47.05001° N, 8.29922° E."),
    (OFFSETS, "power, cable or antenna of b (−6.8 dB), at 47.05000° N, 8.30000° E.")], ids=lambda each: str(each)[10:25])
def test_an_object_is_named_with_its_size_and_its_place(found, sentence, tmp_path):
    origin = {"latitude_deg": 47.05, "longitude_deg": 8.3, "altitude_m": 0.0}
    content = report(effects=[DRIFT | found | {"probability": 0.95}], inputs={"origin": origin})
    assert f"Found: {sentence} With it" in closeloop_summary(content)
    assert sentence in page(content, tmp_path)
    assert ", at x " in closeloop_summary(content | {"inputs": {}})


def test_what_is_not_sure_is_said_to_be_probable(tmp_path):
    text = page(report(effects=[DRIFT | {"probability": 0.561}]), tmp_path)
    assert "Probable: gain of r&lt;0&gt; that changes with time (probability 0.56). With it the RMSE" in text
    assert "<dd>probable: receiver drift</dd>" in text
    both = [DRIFT | {"probability": 0.97}, DRIFT | {"name": "foliage", "rank": 2, "probability": 0.6}]
    assert "Probable: gain of r<0> that changes with time; vegetation (r<0>) (probability 0.60 and more). With them" \
        in closeloop_summary(report(effects=both))
    assert "Found: gain of r<0> that changes with time. With it" in closeloop_summary(report(effects=both[:1]))
    twice = [DRIFT | {"rank": rank, "probability": 0.78} for rank in (1, 2)]
    assert "changes with time (probability 0.78 each). With them" in closeloop_summary(report(effects=twice))
    assert "<dd>probable: receiver drift (2 times)</dd>" in page(report(effects=twice), tmp_path)


def test_rivals_are_those_of_the_step_at_which_the_cause_was_found(tmp_path):
    """A fault on one flight is found before: what is likely beside it is no rival of it."""
    effects = [DRIFT | {"name": "episode", "probability": 0.7}, DRIFT | {"rank": 2, "probability": 0.8}]
    found = report(effects=effects)
    found["posterior"][0]["step"] = 2
    text = rivals(found)
    assert text == "Probability that it is there: episode 0.70 and receiver drift 0.80. "


def test_a_rival_that_the_data_cannot_tell_from_it_has_no_number_beside_it():
    found = report(effects=[DRIFT | {"probability": 0.6, "indistinguishable_from": ["antenna_pattern"]}])
    assert rivals(found).endswith("What else it may be: antenna pattern (the data cannot tell them apart) and nothing is "
                                  "missing 0.28.")


def test_a_step_between_flights_has_no_probability_and_is_called_probable(tmp_path):
    text = closeloop_summary(report(effects=[DRIFT | {"probability": None}]))
    assert "Probable: gain of r<0> that changes with time. With it the RMSE on held-out links falls" in text
    rising = report(effects=[DRIFT | {"probability": 0.7}])
    rising["error"]["after"] |= {"rmse_db": 3.01}
    assert "goes from 3.00 to 3.01 dB" in closeloop_summary(rising)
    rising["error"]["after"] |= {"rmse_db": 2.999}
    assert "stays at 3.00 dB" in closeloop_summary(rising)


def test_what_was_not_looked_for_is_said_and_parts_of_the_error_are_no_larger_than_it():
    unnamed = report("undecided")
    unnamed["posterior"][0] |= {"rest_db": 9.0, "probabilities": [
        {"name": "not in the catalogue", "probability": 0.43}, {"name": "antenna_pattern", "probability": 0.34}]}
    unnamed["candidates"] = [unnamed["candidates"][0] | {
        "name": "body_shadowing", "variant": "loss around the body",
        "reason": "not looked for: there is no heading_deg, so directions are unknown", "kept": False}]
    text = closeloop_summary(unnamed)
    assert "Likeliest: something that is not in the catalogue (0.43) and antenna pattern (0.34). The" in text
    assert "Not looked for, as there is no heading_deg: body shadowing (loss around the body)." in text
    assert "Of the base's 3.00 dB, roughly 2.97 dB repeat at a place" in text and "and 0.41 dB differ" in text  # 9 to 1.25
    assert "Not looked for" not in closeloop_summary(report("undecided"))


@pytest.mark.parametrize("likelihood, is_said", [(0.87, True), (0.49, False)])
def test_what_is_left_without_a_name_beside_the_effects_is_said(likelihood, is_said):
    found = report()
    found["posterior"].append(found["posterior"][0] | {"step": 2, "probabilities": [
        {"name": "not in the catalogue", "probability": likelihood}, {"name": "none", "probability": 1 - likelihood}]})
    assert ("Beside it something is left that has no name (probability 0.87)." in closeloop_summary(found)) == is_said


@pytest.mark.parametrize("verdict", ["none", "undecided"])
def test_errors_of_a_map_are_spoken_of_where_there_is_one(verdict):
    without = report(verdict, base="log-distance")
    hidden = {"by_los": {"nlos": {"before": SCORES, "after": SCORES}}}
    assert "the map" not in closeloop_summary(without) and "(shadowing)" in closeloop_summary(without)
    for given in ({"inputs": {"scene": "city"}}, {"base": "raytrace"}, {"error": without["error"] | hidden}):
        assert "errors of the map and its materials" in closeloop_summary(without | given)


def test_a_last_resort_is_not_called_an_explanation(tmp_path):
    shadowing = DRIFT | {"name": "correlated_shadowing", "rank": 2}
    filled = report("located", effects=[shadowing])
    assert "which explains nothing, brings the RMSE to 3.00 dB" in closeloop_summary(filled)
    filled = report("effect", effects=[DRIFT | {"probability": 0.95}, shadowing])
    filled["error"]["after"] |= {"rmse_db": 1.5}
    text = closeloop_summary(filled)
    assert "With it the RMSE on held-out links falls from 3.00 to 2.00 dB" in text
    assert "brings the RMSE to 1.50 dB" in text and "found: receiver drift<" in page(filled, tmp_path)


def test_a_figure_outside_the_folder_is_not_read(tmp_path):
    folder = tmp_path / "run"
    (folder / "effect_1_").mkdir(parents=True)
    picture = BytesIO()
    Figure().savefig(picture, format="png")
    (tmp_path / "private.png").write_bytes(picture.getvalue())
    stranger = report(effects=[DRIFT | {"name": "/../../private"}])
    assert "data:image/png" not in page(stranger, folder)
    (folder / "waterfall.png").symlink_to(tmp_path / "private.png")
    with pytest.raises(BadInput, match="waterfall.png leads out of"):
        page(stranger, folder)
    (folder / "waterfall.png").unlink()
    os.mkfifo(folder / "waterfall.png")
    assert "data:image/png" not in page(stranger, folder), "nor waited for"
    (folder / "waterfall.png").unlink()
    (folder / "waterfall.png").write_bytes(b"<svg onload=alert()>")
    with pytest.raises(BadInput, match="waterfall.png is not a PNG file"):
        page(stranger, folder)
    (folder / "waterfall.png").write_bytes(picture.getvalue()[:16] + b"\xff" * 8)
    with pytest.raises(BadInput, match="pixels; at most .* RADIOTWIN_MAX_PICTURE_PIXELS"):
        page(stranger, folder)
    os.truncate(folder / "waterfall.png", 2**34)
    with pytest.raises(BadInput, match="bytes; at most .* RADIOTWIN_MAX_PICTURE_BYTES"):
        page(stranger, folder)


def test_an_effect_that_no_size_would_have_shown_is_no_row(tmp_path):
    unseen = {"name": "episode", "size": None, "unit": "dB", "pattern": "over 10 % of the time"}
    text = page(report(detectable=[*report()["detectable"], unseen]), tmp_path)
    assert "Not to be seen in a typical form, at any size that they may have: episode." in text and "– dB" not in text
    text = page(report(detectable=[unseen]), tmp_path)
    assert "may have: episode." in text and "would have been named from" not in text


def test_the_page_tells_how_far_intervals_can_be_trusted(tmp_path):
    prediction = {"best_baseline": "regression_kriging", "best_baseline_rmse_db": 5.5, "combined_rmse_db": 1.9,
                  "advice": "kriging is worse"}
    error = report()["error"] | {"combined": SCORES | {"rmse_db": 1.9, "in_90_percent_interval": 0.874}}
    text = page(report(prediction=prediction, error=error), tmp_path)
    assert "held-out readings in 90 % intervals of the twin" in text and "87 %" in text
    error["combined"] = SCORES  # of a file that was written before
    assert "90 % intervals" not in page(report(prediction=prediction, error=error), tmp_path)


def test_times_since_1970_are_dates_and_no_other_quantity_is(tmp_path):
    start = {"value": 1778554730.4, "low": 1778550000.0, "high": 1778560000.0, "unit": "s"}
    length = {"value": 70.0, "low": 60.0, "high": 80.0, "unit": "s"}
    found = report(effects=[DRIFT | {"parameters": {"start_s[r0]": start, "time_constant_s[r0]": length}}])
    write_closeloop_page(found, tmp_path, "times")
    page = (tmp_path / "closeloop.html").read_text(encoding="utf-8")
    assert "2026-05-12 02:58:50" in page and "2026-05-12 01:40:00" in page and "1778554730" not in page
    assert "60.00 to 80.00" in page


def test_where_nothing_was_found_the_error_stays_and_its_part_of_places_is_shown(tmp_path, monkeypatch):
    roofs = DRIFT | {"is_declared": True}
    nothing = report("none", effects=[roofs])
    text = page(nothing, tmp_path)
    assert "The RMSE on held-out links stays at 3.00 dB. Of the base&#39;s 3.00 dB, roughly 2.68 dB repeat at a place" in text
    assert "<dt>RMSE of 900 links, as before</dt><dd>3.00 dB</dd>" in text
    assert "<dt>of that, repeats at a place</dt><dd>2.68 dB</dd>" in text
    assert "3.00 → " not in text and ">before and after</td>" in text and ">after</td>" not in text
    printed = []
    monkeypatch.setattr(loop, "print_rows", lambda title, columns, rows: printed.append(title))
    loop._print(nothing | {"error": nothing["error"] | {"by_los": {}}, "baselines": {}})
    assert printed[1:] == ["Parts of the base"]


def test_errors_of_other_links_are_no_headline_and_are_labelled(tmp_path):
    error = report()["error"] | {"after_same_links": SCORES | {"n": 900, "rmse_db": 2.4},
                                 "after": SCORES | {"n": 1100, "rmse_db": 2.2}}
    text = page(report(error=error), tmp_path)
    assert "falls from 3.00 to 2.40 dB (the same 900 links)." in text
    assert "<dt>RMSE of 900 links, before and after</dt><dd>3.00 → 2.40 dB</dd>" in text
    assert "2.20" not in text[:text.index("<h2>")]
    assert re.search(r"after, the same links</td><td>900</td>.*2\.40", text)
    assert re.search(r">after</td><td>1,100</td>.*2\.20", text)


def test_a_name_that_is_the_word_for_its_kind_is_quoted(tmp_path):
    named = LOW | {"members": {"device": ["d3"], "receiver": ["receiver"]}, "family": "device x receiver"}
    found = report("located", anomalies=[named])
    found["error"]["by_flight"] = {"flight": {"before": SCORES, "after": SCORES}}
    text = page(found, tmp_path)
    assert "Device d3 with receiver &#39;receiver&#39; reads" in text and "receiver receiver" not in text
    assert "flight &#39;flight&#39;" in text


@pytest.mark.parametrize("verdict, is_drawn", [("located", True), ("none", False)])
def test_captions_explain_what_is_drawn_alone(tmp_path, verdict, is_drawn):
    for name in ("residual_map", "groups"):
        Figure().savefig(tmp_path / f"{name}.png")
    text = page(report(verdict), tmp_path)
    assert ("Purple: what was found" in text, "Framed: groups" in text) == (is_drawn, is_drawn)
