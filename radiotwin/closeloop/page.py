"""The report as one HTML file with its figures inside, which opens without a network."""

import base64
import html
from pathlib import Path

from radiotwin.demo_page import STYLE
from radiotwin.files import atomic_path

FIGURES = (
    ("waterfall.png", "From step to step", "Error on links that took no part in choosing or fitting."),
    ("residual_map.png", "Where the error is", "Measured minus predicted on held-out links, before and after. A "
     "traced box is drawn in purple."),
    ("drivers.png", "What the error depended on", "Mean held-out residual against the strongest variables."),
)
VERDICTS = {
    "effect": "The model lacked {names}. With {it} the error on held-out links falls from {before:.2f} to "
              "{after:.2f} dB (RMSE).",
    "none": "Nothing is missing: what the model leaves over ({before:.2f} dB) depends on none of the variables that "
            "were tested, and no effect of the catalogue lowers it.",
    "unexplained": "Something is missing, and none of the effects in the catalogue explains it: the error "
                   "({before:.2f} dB) depends on {drivers}.",
}


LABELS = {"los": "with line of sight", "nlos": "without line of sight"}


def lead(report: dict) -> str:
    """The result in a sentence or two, whichever way it comes out."""
    names = [effect["name"] for effect in report["effects"]]
    drivers = [driver["variable"] for driver in report["remaining"]["drivers"]]
    text = VERDICTS[report["verdict"]].format(
        names=_listed(names), it="it" if len(names) == 1 else "them", drivers=_listed(drivers),
        before=report["error"]["before"]["rmse_db"], after=report["error"]["after"]["rmse_db"])
    if report["verdict"] == "effect" and drivers:
        text += f" What is left still depends on {_listed(drivers[:4])}."
    return text


def write_page(report: dict, folder: Path, title: str) -> None:
    """Write `closeloop.html` from the report and the figures that lie in `folder`."""
    parts = [f"<h1>{html.escape(title)}</h1>", f'<p class="lead">{html.escape(lead(report))}</p>',
             _errors(report, ("los",))]
    for name, heading, text in FIGURES:
        data = base64.b64encode((folder / name).read_bytes()).decode()
        parts.append(f'<h2>{heading}</h2><p>{text}</p><img alt="{heading}" src="data:image/png;base64,{data}">')
    parts += [_effects(report), _candidates(report), "<h2>By device, receiver and flight</h2>",
              _errors(report, ("device", "receiver", "flight")), _remarks(report)]
    page = (f'<!doctype html><html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">'
            f"<title>{html.escape(title)}</title><style>{STYLE}</style><main>{''.join(parts)}</main></html>")
    with atomic_path(folder / "closeloop.html") as temporary:
        temporary.write_text(page, encoding="utf-8")


def _effects(report: dict) -> str:
    rows = [[effect["rank"] if number == 0 else "", effect["name"] if number == 0 else "", name, _number(p["value"]),
             f"{_number(p['low'])} to {_number(p['high'])}", p["unit"]]
            for effect in report["effects"] for number, (name, p) in enumerate(effect["parameters"].items())]
    columns = ["", "effect", "parameter", "value", "90 % interval", "unit"]
    return _table("What was missing", columns, rows) if rows else ""


def _errors(report: dict, kinds: tuple[str, ...]) -> str:
    columns = ("n", "bias_db", "std_db", "correlation", "rmse_db", "mae_db", "nll")
    rows = []
    groups = {"all": {"all links": report["error"]}} if "los" in kinds else {}
    groups |= {name: report["error"].get(f"by_{name}", {}) for name in kinds}
    for name, group in groups.items():
        for label, both in group.items():
            if len(group) <= 40 and both["before"]["n"]:
                rows += [[LABELS.get(label, f"{name} {label}") if name != "all" else label, when,
                          *(_number(both[when][column]) for column in columns)] for when in ("before", "after")]
    if "los" in kinds:
        rows += [[name.replace("_", " "), "", "", "", "", "", _number(value["rmse_db"]), "", ""]
                 for name, value in report["baselines"].items()]
    return _table(f"Error on held-out links (by {report['heldout']['by']}, {report['heldout']['folds']} folds)",
                  ["links", "", "n", "mean [dB]", "standard deviation [dB]", "correlation", "RMSE [dB]", "MAE [dB]",
                   "−log-likelihood [nats]"], rows)


def _candidates(report: dict) -> str:
    rows = [[c["step"], c["name"], _number(c["heldout_nll_gain"]), _number(c["heldout_rmse_db"]), _number(c["p_value"]),
             "kept" if c["kept"] else c["reason"]] for c in report["candidates"]]
    return "<h2>What was tried</h2>" + _table(
        "", ["step", "effect", "held-out gain [nats]", "held-out RMSE [dB]", "p", ""], rows)


def _remarks(report: dict) -> str:
    if not report["remarks"]:
        return ""
    return "<h2>Remarks on the data</h2><ul>" + "".join(f"<li>{html.escape(remark)}</li>"
                                                        for remark in report["remarks"]) + "</ul>"


def _table(title: str, columns: list[str], rows: list[list]) -> str:
    head = "".join(f"<th>{html.escape(column)}</th>" for column in columns)
    body = "".join(f"<tr>{''.join(f'<td>{html.escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
    return f'<div class="scroll"><table><caption>{html.escape(title)}</caption><tr>{head}</tr>{body}</table></div>'


def _number(value) -> str:
    if value is None:
        return "–"
    return str(value) if isinstance(value, int) else f"{value:.3g}" if abs(value) < 1 else f"{value:.2f}"


def _listed(names: list[str]) -> str:
    names = list(dict.fromkeys(names))
    return names[0] if len(names) == 1 else ", ".join(names[:-1]) + " and " + names[-1] if names else "nothing named"
