"""The page of a close-loop: right for each verdict, and never stopped by what a file may hold."""

import html
import os
import re
from io import BytesIO

import pytest
from matplotlib.figure import Figure

from radiotwin.cli import model as loop
from radiotwin.errors import BadInput
from radiotwin.report.closeloop_page import write_closeloop_page
from radiotwin.report.closeloop_words import closeloop_summary, drivers, rivals
from radiotwin.report.labels import quantity

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


def test_names_from_the_data_are_no_markup(tmp_path):
    text = page(report(), tmp_path)
    for written in ("device &lt;b&gt;", "step (r&lt;0&gt;)", "receiver &lt;i&gt; has 3 only",
                    "Close-loop of &lt;x&gt;"):
        assert written in text
    assert "<i>" not in text and "<x>" not in text


def with_effect(*changes, **others):
    """A report of one effect for each of the changes of `DRIFT`."""
    return report(effects=[DRIFT | {"rank": rank} | each for rank, each in enumerate(changes, 1)], **others)


def with_error(verdict="effect", parts=(), **changes):
    """A report with other scores; `parts`: changes of scores of `after`."""
    content = report(verdict)
    content["error"] = content["error"] | changes
    content["error"]["after"] = content["error"]["after"] | dict(parts)
    return content


def with_step(verdict="effect", **changes):
    """A report whose search had other probabilities in its last step."""
    content = report(verdict)
    content["posterior"] = [*content["posterior"] * (verdict == "effect"), content["posterior"][0] | changes]
    return content


def parameter(value, low, high, unit):
    return {"value": value, "low": low, "high": high, "unit": unit}


def left(chance):
    return with_step(step=2, probabilities=[{"name": "not in the catalogue", "probability": chance},
                                            {"name": "none", "probability": 1 - chance}])


def settled(**ends):
    """Two trials of an antenna, the likelier one of these ends."""
    tried = report()["candidates"][0] | {"name": "antenna_pattern", "variant": "of some kind", "probability": 0.4, "kept": False}
    return report("undecided", candidates=[tried, tried | ends | {"probability": 0.45}])


SHADOWING = {"name": "correlated_shadowing", "rank": 2}
NOT_TRIED = {"name": "body_shadowing", "variant": "loss around the body", "kept": False,
             "reason": "not looked for: there is no heading_deg, so directions are unknown"}
UNSEEN = {"name": "episode", "size": None, "unit": "dB", "pattern": "over 10 % of the time"}
LIKE_D3 = LOW | {"members": {"device": ["d3"], "receiver": ["receiver"]}, "family": "device x receiver"}
SAME_LINKS = {"after_same_links": SCORES | {"n": 900, "rmse_db": 2.4}, "after": SCORES | {"n": 1100, "rmse_db": 2.2}}
LEARNABLE = {"before": SCORES | {"n": 800, "rmse_db": 2.5}, "after": SCORES | {"n": 800, "rmse_db": 2.0}}
NLOS = {"by_los": {"nlos": {"before": SCORES, "after": SCORES}}}
ON_A_MAP, NO_MAP = "errors of the map and its materials", "repeat at a place (shadowing)"
SAID = [  # a report, what its page says, and what it does not say
    (settled(devices=["n3"]), ["To settle it: fly around device n3 at one distance", "antenna pattern: of some kind</td>"], []),
    (settled(devices=["n3", "n4"]), ["fly around the device at one distance and one height (devices n3, n4)."], []),
    (settled(receivers=["uav0"]), ["fly the same track in both directions (receiver uav0)."], []),
    (report(), ["2 trials in 1 step<", "bias [dB]", "standard deviation [dB]", "log-distance law", "7.00", "kriging", "median db",
                "The data cannot distinguish it from receiver gain offset.", "Effects that may look alike: interference.",
                "−6.50 to −5.50", "nothing in the residual looks like it"], ["Not looked for"]),
    (with_effect({"probability": 0.6, "size_db": parameter(4.0, 3.0, 5.0, "dB")}),
     ["Probability that it is there: receiver drift 0.60.", "by 4.00 dB (RMS; 90 % interval 3.00 to 5.00)", "4.2 dB/km",
      "What else it may be: receiver gain offset (the data cannot tell them apart), nothing is missing 0.28 and antenna pattern 0.12."],
     []),  # 0.4 are left
    (with_effect({"size_db": parameter(None, None, None, "dB")}), ["It changes no level, only which links are blank."], ["by – dB"]),
    (with_effect({"probability": 0.561}), ["Probable: gain of r<0> that changes with time (probability 0.56). With it the RMSE",
                                           "<dd>probable: receiver drift</dd>"], []),
    (with_effect({"probability": 0.97}, {"name": "foliage", "probability": 0.6}),
     ["Probable: gain of r<0> that changes with time; vegetation (r<0>) (probability 0.60 and more). With them"], []),
    (with_effect({"probability": 0.78}, {"probability": 0.78}),
     ["changes with time (probability 0.78 each). With them", "<dd>probable: receiver drift (2 times)</dd>"], []),
    (with_effect({"probability": None}), ["Probable: gain of r<0> that changes with time. With it the RMSE on held-out links falls"], []),
    (with_error(parts={"rmse_db": 3.01}), ["goes from 3.00 to 3.01 dB"], []),
    (with_error(parts={"rmse_db": 2.999}), ["stays at 3.00 dB"], []),
    (with_error(learnable=LEARNABLE), ["100 of these links lie at a fault or a change that only links held out with them show; "
                                       "without them it is 2.50 dB before and 2.00 dB after."], []),
    (with_step("undecided", rest_db=9.0, probabilities=[{"name": "not in the catalogue", "probability": 0.43},
                                                        {"name": "antenna_pattern", "probability": 0.34}]),
     ["Likeliest: something that is not in the catalogue (0.43) and antenna pattern (0.34). The",
      "Of the base's 3.00 dB, roughly 2.97 dB repeat at a place", "and 0.41 dB differ"], []),  # 9 to 1.25
    (report("undecided", candidates=[report()["candidates"][1] | NOT_TRIED]),
     ["Not looked for, as there is no heading_deg: body shadowing (loss around the body)."], []),
    (left(0.87), ["Beside it something is left that has no name (probability 0.87)."], []),
    (left(0.49), [], ["something is left that has no name"]),
    *((report(verdict, base="log-distance"), [NO_MAP], [ON_A_MAP]) for verdict in ("none", "undecided")),
    (report("none", inputs={"scene": "city"}), [ON_A_MAP], [NO_MAP]), (report("none", base="raytrace"), [ON_A_MAP], [NO_MAP]),
    (with_error("undecided", **NLOS), [ON_A_MAP], [NO_MAP]),
    (report("located", effects=[DRIFT | SHADOWING]), ["which explains nothing, brings the RMSE to 3.00 dB"], []),
    (with_error(parts={"rmse_db": 1.5}) | {"effects": [DRIFT | {"probability": 0.95}, DRIFT | SHADOWING]},
     ["With it the RMSE on held-out links falls from 3.00 to 2.00 dB", "brings the RMSE to 1.50 dB", "found: receiver drift<"], []),
    (report(detectable=[*report()["detectable"], UNSEEN]),
     ["Not to be seen in a typical form, at any size that they may have: episode.", "would have been named from"], ["– dB"]),
    (report(detectable=[UNSEEN]), ["may have: episode."], ["would have been named from"]),
    (with_error(combined=SCORES | {"in_90_percent_interval": 0.874}), ["<dt>held-out readings in 90 % intervals of the twin</dt><dd>87 %"], []),
    (with_error(combined=SCORES), [], ["90 % intervals"]),  # of a file that was written before
    (with_effect({"parameters": {"start_s[r0]": parameter(1778554730.4, 1778550000.0, 1778560000.0, "s"),
                                 "time_constant_s[r0]": parameter(70.0, 60.0, 80.0, "s")}}),
     ["2026-05-12 02:58:50", "2026-05-12 01:40:00", "60.00 to 80.00"], ["1778554730"]),
    (report("none", effects=[DRIFT | {"is_declared": True}]),
     ["The RMSE on held-out links stays at 3.00 dB. Of the base's 3.00 dB, roughly 2.68 dB repeat at a place",
      "<dt>RMSE of 900 links, as before</dt><dd>3.00 dB</dd>", "<dt>of that, repeats at a place</dt><dd>2.68 dB</dd>",
      ">before and after</td>"], ["3.00 → ", ">after</td>"]),
    (with_error(**SAME_LINKS), ["falls from 3.00 to 2.40 dB (the same 900 links).", "after, the same links</td><td>900</td>",
                                "<dt>RMSE of 900 links, before and after</dt><dd>3.00 → 2.40 dB</dd>", ">after</td><td>1,100</td>"], []),
    (with_error("located", by_flight={"flight": {"before": SCORES, "after": SCORES}}) | {"anomalies": [LIKE_D3]},
     ["Device d3 with receiver 'receiver' reads", "flight 'flight'"], ["receiver receiver"]),
    (report("none", baselines={"log_distance": NOTHING}, dependences_before=[],
            error=report()["error"] | {"before": NOTHING, "after": NOTHING}), ["no cause was found"], ["None", "nan"]),
    (with_effect({"parameters": {"offset_db[a]": parameter(0.0, 0.0, 0.0, "dB"), "x_m": parameter(0.0, 0.0, 0.0, "m")}}),
     ["offset (a)</td><td>0 (reference)</td><td>–</td>", "x, east</td><td>0.00"], []),
]


@pytest.mark.parametrize(("content", "said", "not_said"), SAID)
def test_a_page_says(tmp_path, content, said, not_said):
    text = html.unescape(page(content, tmp_path))
    assert [each for each in said if each not in text] == [] == [each for each in not_said if each in text]
    assert not re.search(r"</th></tr>\s*</table>", text), "no table is empty"


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


@pytest.mark.parametrize("value, text", [(0.0, "0.00"), (0.003, "0.003"), (-0.00214, "−0.0021"), (0.07, "0.07"),
                                         (-6.5, "−6.50"), (12345.6, "12,346"), (3, "3"), (None, "–")])
def test_no_parameter_is_rounded_to_nothing(value, text):
    assert quantity(value, "dB") == text


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


def test_what_is_printed_is_what_the_page_says(monkeypatch):
    printed, nothing = {}, {"error": with_error(by_los={})["error"], "baselines": {}}

    def rows(content):
        printed.clear()
        loop._print(content)
        return printed
    monkeypatch.setattr(loop, "print_rows", lambda title, columns, rows: printed.update({title: rows}))
    offsets = {"offset_db[a]": parameter(0.0, 0.0, 0.0, "dB"), "offset_db[b]": parameter(3.0, 2.5, 3.5, "dB")}
    assert [row[2] for row in rows(with_effect({"parameters": offsets}) | nothing)["Added to the base"]] == ["reference", 3.0]
    assert len(rows(report("none") | nothing)) == 1  # of errors
    assert [*rows(report("none", effects=[DRIFT | {"is_declared": True}]) | nothing)][1:] == ["Parts of the base"]
    vague = {"x_m": parameter(-1.4, -139.0, 136.0, "dB") | {"determined": False}}
    known = with_error(by_los={}, after_with_quality=SCORES | {"rmse_db": 1.0})["error"]
    groups, errors, added = rows(report("located", effects=[DRIFT | {"parameters": vague}], error=known, baselines={})).values()
    assert [[row[0], *row[2:5]] for row in groups] == [["device d3", "level", "−5.6 dB", "−6.1 to −5.1"]]
    assert [row[1:4] for row in errors] == [["before", "900", 3.0], ["after", "900", 2.0],
                                            ["after, with each reading's own quality", "900", 1.0]]
    assert added[0][2] == "not determined" and added[0][3] != added[0][3]


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


def test_rivals_are_those_of_the_step_at_which_the_cause_was_found():
    """A fault on one flight is found before: what is likely beside it is no rival of it."""
    found = with_effect({"name": "episode", "probability": 0.7}, {"probability": 0.8})
    found["posterior"][0]["step"] = 2
    assert rivals(found) == "Probability that it is there: episode 0.70 and receiver drift 0.80. "
    same = with_effect({"probability": 0.6, "indistinguishable_from": ["antenna_pattern"]})
    assert rivals(same).endswith("What else it may be: antenna pattern (the data cannot tell them apart) and nothing is "
                                 "missing 0.28."), "a number would say that they can be told apart"


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


@pytest.mark.parametrize("verdict, is_drawn", [("located", True), ("none", False)])
def test_captions_explain_what_is_drawn_alone(tmp_path, verdict, is_drawn):
    for name in ("residual_map", "groups"):
        Figure().savefig(tmp_path / f"{name}.png")
    text = page(report(verdict), tmp_path)
    assert ("Purple: what was found" in text, "Framed: groups" in text) == (is_drawn, is_drawn)
