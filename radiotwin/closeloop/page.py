"""The report as one HTML file with its figures inside, which opens without a network."""

import html
from collections import Counter
from pathlib import Path

from radiotwin.closeloop.words import LAST_RESORTS, listed, parameter, plainly, variable
from radiotwin.files import atomic_path
from radiotwin.pages import STYLE, details, image, table

FIGURES = (
    ("waterfall.png", "From step to step", "Error on links that took no part in choosing or fitting: the model alone, "
     "what each effect that was added takes off, and what is left. Thin lines: other models, held out alike."),
    ("residual_map.png", "Where the error is", "Measured minus predicted on held-out links, before and after. Red: "
     "measured less than predicted. What was found is drawn in purple."),
    ("level_map.png", "Levels on the map", "Measured, predicted for the same links from others, and the difference, by "
     "the place of the end that moves."),
    ("drivers.png", "What the error depends on", "Mean held-out residual against the variables that matter most, with "
     "one standard error; dashed: what the effects add to the prediction there."),
)
VERDICTS = {
    "effect": "The model lacked {names}. With {it} the error on held-out links falls from {before} to {after} dB "
              "(RMSE).",
    "none": "Nothing is missing: what the model leaves over ({before} dB) depends on none of the variables that were "
            "tested, and no effect of the catalogue lowers it.",
    "unexplained": "Something is missing, and none of the effects in the catalogue is_cause it: the error "
                   "({before} dB) depends on {drivers}.",
}
BADGES = {"effect": "found: ", "none": "nothing is missing", "unexplained": "unexplained"}
KINDS = {"los": "", "device": "device ", "receiver": "receiver ", "flight": "flight "}
LABELS = {"los": "with line of sight", "nlos": "without line of sight"}
COLUMNS = {"n": "links", "bias_db": "mean [dB]", "std_db": "standard deviation [dB]", "correlation": "correlation",
           "rmse_db": "RMSE [dB]", "mae_db": "MAE [dB]", "nll": "−log-likelihood [nats]"}
FIGURES_OF_MERIT = (("rmse_db", "error, RMSE", "dB"), ("bias_db", "mean error", "dB"),
                    ("std_db", "standard deviation", "dB"), ("correlation", "correlation", ""))
MAX_NAMED = 4  # variables in a sentence
MAX_ROWS = 40  # of a group in the tables
MORE_STYLE = """
body { background: #fff } h2 { font-size: 1.25rem; border-top: 1px solid #dde2e6; padding-top: 1.2rem }
h3 { font-size: 1.05rem; margin: 1.6rem 0 .2rem } summary { cursor: pointer; font-weight: 600; margin: .8rem 0 }
.cards { display: flex; flex-wrap: wrap; gap: .8rem; margin: 1.2rem 0 }
.card { border: 1px solid #dde2e6; border-radius: 8px; padding: .6rem 1rem; flex: 1 1 7.5rem }
.card b { display: block; font-size: 1.2rem; white-space: nowrap; font-variant-numeric: tabular-nums }
.card span { color: #4a5964; font-size: .88rem }
.verdict { border-left: 6px solid #1f6f8b; flex-basis: 13rem } .verdict b { white-space: normal; font-size: 1.05rem }
code { color: #5b6b78; font-size: .85em; font-weight: 400 }
"""


def lead(report: dict) -> str:
    """The result in a sentence or two, whichever way it comes out."""
    names = _named(report)
    explaining = _explaining(report)
    drivers = [_variable(driver) for driver in report["remaining"]["drivers"]]
    before, after = (_number(report["error"][when]["rmse_db"]) for when in ("before", "after"))
    filled = len(explaining) < len(report["effects"])
    explained = [candidate["heldout_rmse_db"] for candidate in report["candidates"]
                 if candidate["kept"] and candidate["name"] not in LAST_RESORTS]
    text = VERDICTS[report["verdict"]].format(
        names=listed(names), it="it" if len(explaining) == 1 else "them", before=before,
        after=_number(explained[-1]) if filled and explained else after,
        drivers=listed((drivers or [_variable(driver) for driver in report.get("structure_before", [])])[:MAX_NAMED]))
    if report["verdict"] == "effect" and drivers:
        text += f" What is left still depends on {listed(drivers[:MAX_NAMED])}."
    if filled:
        text += f" Interpolating the rest, which is_cause nothing, brings it to {after} dB."
    return text


def write_page(report: dict, folder: Path, title: str) -> None:
    """Write `closeloop.html` from the report and the figures that lie in `folder`."""
    parts = [f"<h1>{html.escape(title)}</h1>", *sections(report, folder),
             f"<footer>{html.escape(_facts(report))}</footer>"]
    page = ('<!doctype html><html lang="en"><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(title)}</title><style>{STYLE}{MORE_STYLE}</style><main>{''.join(parts)}</main></html>")
    with atomic_path(folder / "closeloop.html") as temporary:
        temporary.write_text(page, encoding="utf-8")


def sections(report: dict, folder: Path) -> list[str]:
    """All that the page says between its title and its last line."""
    figures = [f"<h2>{heading}</h2><p>{text}</p>{image(folder / name, heading)}" for name, heading, text in FIGURES]
    return [f'<p class="lead">{html.escape(lead(report))}</p>', _cards(report), *figures, _effects(report, folder),
            "<h2>Error before and after</h2>", _errors(report, ("los",)),
            details("by device, receiver and flight", _errors(report, ("device", "receiver", "flight"))),
            _candidates(report), _remaining(report), _remarks(report)]


def _cards(report: dict) -> str:
    verdict = BADGES[report["verdict"]] + (listed(_named(report)) if report["verdict"] == "effect" else "")
    cards = [f'<div class="card verdict"><span>verdict</span><b>{html.escape(verdict)}</b></div>']
    for key, words, unit in FIGURES_OF_MERIT:
        before, after = (_number(report["error"][when].get(key)) for when in ("before", "after"))
        text = before if before == after and not report["effects"] else f"{before} → {after}"
        cards.append(f'<div class="card"><span>{words}</span><b>{text} {unit}</b></div>')
    return f'<div class="cards">{"".join(cards)}</div>'


def _effects(report: dict, folder: Path) -> str:
    parts, filled = ["<h2>What was missing</h2>"] if _named(report) else [], False
    for effect in report["effects"]:
        name = plainly(effect["name"])
        if effect["name"] in LAST_RESORTS and not filled:
            parts.append("<h2>What is filled in, not explained</h2>")
            filled = True
        parts.append(f"<h3>{effect['rank']}. {html.escape(name)} <code>{html.escape(effect['name'])}</code></h3>"
                     f"<p>{html.escape(_evidence(effect))}</p>")
        parts.append(image(folder / f"effect_{effect['rank']}_{effect['name']}.png", name))
        rows = [[parameter(key), _number(p["value"]), _interval(p), p["unit"]]
                for key, p in effect["parameters"].items()]
        found = table("", ["parameter", "value", "90 % interval", "unit"], rows)
        parts.append(found if len(rows) <= 12 else details(f"{len(rows)} parameters", found))
    return "".join(parts)


def _explaining(report: dict) -> list[dict]:
    """The effects that explain something, which an interpolation does not."""
    return [effect for effect in report["effects"] if effect["name"] not in LAST_RESORTS]


def _named(report: dict) -> list[str]:
    """Their names, and how often each was found."""
    times = Counter(plainly(effect["name"]) for effect in _explaining(report))
    return [name if count == 1 else f"{name} ({count} times)" for name, count in times.items()]


def _evidence(effect: dict) -> str:
    """Which form of it, how sure it is, and what else it may be."""
    text = f"{effect['variant'].capitalize()}. " if effect.get("variant") else ""
    evidence = effect["evidence"]
    text += (f"Held-out links are likelier by {_number(evidence['heldout_nll_gain'])} nats with it (p "
             f"{_p_value(evidence['p_value'])}).")
    same = [plainly(name) for name in effect.get("indistinguishable_from", [])]
    alike = [plainly(name) for name in effect.get("confused_with", []) if plainly(name) not in same]
    if same:
        text += f" The data cannot tell it from {listed(same)}."
    return text + (f" Others that may look alike: {listed(alike)}." if alike else "")


def _errors(report: dict, kinds: tuple[str, ...]) -> str:
    """Before and after for groups of links; other models under those of all links."""
    rows, others = [], report["baselines"] if "los" in kinds else {}
    columns = [*COLUMNS, *dict.fromkeys(key for scores in others.values() for key in scores if key not in COLUMNS)]
    groups = [("all links", report["error"])] if "los" in kinds else []
    for kind in kinds:
        group = report["error"].get(f"by_{kind}", {})
        groups += [(LABELS.get(name, KINDS[kind] + name), both) for name, both in group.items()
                   if len(group) <= MAX_ROWS and both["before"]["n"]
                   and (kind != "los" or both["before"]["n"] < report["error"]["before"]["n"])]
    for number, (label, both) in enumerate(groups):
        rows += [[label if when == "before" else "", when, *(_number(both[when].get(key)) for key in columns)]
                 for when in ("before", "after")]
        if number == 0:
            rows += [["", plainly(name), *(_number(scores.get(key)) for key in columns)]
                     for name, scores in others.items()]
    heldout = report["heldout"]
    return table(f"On held-out links (by {heldout['by']}, {heldout['folds']} folds)",
                  ["", "model", *(COLUMNS.get(key, key.replace("_", " ")) for key in columns)], rows, left=2)


def _candidates(report: dict) -> str:
    rows = [[c["step"], plainly(c["name"]), "kept" if c["kept"] else c["reason"], _number(c["heldout_nll_gain"]),
             _number(c["heldout_rmse_db"]), _p_value(c["p_value"])] for c in report["candidates"]]
    strong = [number for number, c in enumerate(report["candidates"]) if c["kept"]]
    steps = len({c["step"] for c in report["candidates"]})
    tried = table("", ["step", "effect", "kept, or why not", "held-out gain [nats]", "held-out RMSE [dB]", "p"], rows,
                   left=3, strong=strong)
    return "<h2>What was tried</h2>" + details(f"{len(rows)} trials in {steps} steps", tried)


def _remaining(report: dict) -> str:
    drivers = report["remaining"]["drivers"]
    if not drivers:
        return "<h2>What remains</h2><p>No structure: the rest depends on none of the variables that were tested.</p>"
    rows = [[_variable(driver), _number(driver.get("effect_db")), _p_value(driver["p_value"])] for driver in drivers]
    return "<h2>What remains</h2><p>The rest still depends on:</p>" + table(
        "", ["variable", "scatter of the mean residual over it [dB]", "p, corrected"], rows)


def _remarks(report: dict) -> str:
    if not report["notes"]:
        return ""
    return "<h2>Remarks on the data</h2><ul>" + "".join(f"<li>{html.escape(remark)}</li>"
                                                        for remark in report["notes"]) + "</ul>"


def _facts(report: dict) -> str:
    heldout, floor_db = report["heldout"], report["error"]["noise_floor_db"]
    facts = [f"radiotwin {report.get('radiotwin_version', '')}", f"base {report['base']}",
             f"{heldout['n']:,} links held out by {heldout['by']}"]
    if floor_db is not None:
        facts.append(f"links measured again at one place scatter by {floor_db:.2f} dB")
    return " · ".join(facts)


def _variable(driver: dict) -> str:
    return variable(driver["variable"])[0]


def _number(value) -> str:
    if value is None:
        return "–"
    if isinstance(value, int):
        text = f"{value:,}"
    elif 0.0005 < abs(value) < 0.1:
        text = f"{value:.2g}"
    else:
        text = f"{value:.2f}" if abs(value) < 1000 else f"{value:,.0f}"
    return text.replace("-", "−")


def _interval(p: dict) -> str:
    if p["low"] is None or p["high"] is None or p["low"] == p["high"]:
        return "–"
    return f"{_number(p['low'])} to {_number(p['high'])}"


def _p_value(value: float | None) -> str:
    return "–" if value is None else "< 0.001" if value < 0.001 else f"{value:.3f}"
