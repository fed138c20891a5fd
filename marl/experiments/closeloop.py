"""The table of what `close-loop` found in hidden cases, where nothing is hidden, and in real measurements."""

import json
from pathlib import Path

from marl.experiments.tables import markdown, number

RESULTS = Path("docs/results")
UNITS = {"db": "dB", "deg": "°", "m": "m", "s": "s"}
FILES = ("closeloop_undeclared.json", "closeloop_null.json", "real_data.json")


def closeloop_table(folder: Path = RESULTS) -> str:
    """All cases, from the JSON files of `benchmarks/closeloop_*.py` and `benchmarks/real_data.py`."""
    cases, nothing, real = (json.loads((folder / name).read_text(encoding="utf-8")) for name in FILES)
    heads = ["hidden", "seed", "named first", "also named", "recovered", "before [dB]", "after", "oracle"]
    verdicts = [case["verdict"] for case in nothing.values()]
    parts = [f"**Hidden effects in traced cities** ({len(cases)} cases; RMSE of held-out links)\n\n"
             + markdown(heads, [_case_row(name, case) for name, case in cases.items()]),
             f"**Nothing is hidden**, levels drawn from the fitted base: verdict `none` in {verdicts.count('none')} of "
             f"{len(verdicts)}.",
             "**Real measurements**\n\n" + markdown(
                 ["set", "held out by", "log-distance [dB]", "named effects", "with interpolation", "kriging", "named"],
                 [[f"`{name}`", each["heldout"]["by"], *(number(value, 2) for value in (
                     each["before_db"], each.get("named_db") or float("nan"), each.get("after_db") or float("nan"),
                     each["baselines_db"].get("regression_kriging") or float("nan"))), _counted(each["named"])]
                  for name, each in real.items()])]
    return "\n\n".join(parts)


def _case_row(name: str, case: dict) -> list[str]:
    family, seed = name.split(":")
    named = [name for name in case["named"] if name != "correlated_shadowing"]  # interpolation explains nothing
    hidden = {effect["name"] for effect in case["hidden"]}
    first = "–" if not named else f"`{named[0]}`" + (" ✓" if named[0] in hidden else "")
    if not hidden and not named:
        first = "no effect ✓"
    recovered = ", ".join(f"{name.replace('_error', '').rsplit('_', 1)[0].replace('_', ' ')} {value:+.1f} "
                          f"{UNITS[name.rsplit('_', 1)[1]]}"
                          for found in case["recovered"] for name, value in found.items()
                          if "_error_" in name and value is not None)
    return [f"`{family}`", seed, first, _counted(named[1:]), recovered,
            *(number(value, 2) for value in (case["before"]["rmse_db"], case["after"]["rmse_db"],
                                             case["oracle_rmse_db"]))]


def _counted(names: list[str]) -> str:
    return ", ".join(f"`{name}`" + (f" × {names.count(name)}" if names.count(name) > 1 else "")
                     for name in dict.fromkeys(names))
