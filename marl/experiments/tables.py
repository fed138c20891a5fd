"""Tables of the studies as Markdown, from their records alone."""

import numpy as np

from marl.experiments.records import filled
from marl.experiments.summaries import (
    by_name,
    mean_of,
    number,
    over_seeds,
    quantiles,
    scenes,
    shown,
    with_spread,
    worlds,
)
from marl.settings import LearnerSettings, RunSettings

LABELS = {"fedqmix-nn": "model-aided FedQMIX", "qmix-nn": "model-aided QMIX",
          "qmix-log-distance": "model-aided QMIX, log-distance twin", "qmix-truth": "QMIX on real episodes",
          "fedqmix-raytrace": "FedQMIX, ray-traced twin", "iql-truth": "IQL on real episodes",
          "planner-nn": "planner in the NN twin", "planner-raytrace": "planner in the ray-traced twin",
          "greedy": "greedy, distinct targets, true positions", "random": "random"}
LEVELS = ("greedy", "random")
PUBLISHED = {("rbm", 5): "15 m; 10 % above 100 m", ("rbm", 1): "22 m; 38 % above 100 m"}
"""Median error of positions of the published code, as (scene, real episodes)."""
TWINS = {"nn": "segmented network (NN)", "segmented": "segmented log-distance", "log-distance": "log-distance",
         "raytrace": "ray-traced (paths over the map)", "corrected": "corrected (after `close-loop`)",
         "truth": "the truth"}
MODELS = {"segmented_nn": "NN", "log_distance": "log-distance", "regression_kriging": "kriging",
          "raytrace": "ray-traced twin"}
METHODS = {"plan": "open-loop plan", "replan": "re-planning, link", "replan-no-link": "re-planning, no link",
           "policy": "policy, link", "policy-no-link": "policy, no link", "taught": "policy taught by the plan, link",
           "taught-no-link": "the same, no link", "greedy": "greedy"}
SCENARIOS = {"nominal": "as thought", "volumes": "data 0–2 × nominal", "positions": "devices 20–40 m off",
             "loss": "a UAV is lost", "everything": "all three"}
WORLD = ("scene", "truth", "algorithm")  # settings that heads and titles of tables say
ENOUGH = 0.95  # of what both learners reach at least


def markdown(heads: list[str], rows: list[list[str]]) -> str:
    """A table."""
    return "\n".join(["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads),
                      *("| " + " | ".join(row) + " |" for row in rows)])


def curve_table(records: list[dict]) -> str:
    """What is collected at the end, and the real episodes that the same ratio takes."""
    parts = []
    for (truth, scene), runs in worlds(records).items():
        curves = {name: over_seeds(seeds) for name, seeds in runs.items()}
        target, rows = common_ratio(curves), []
        for name in (each for each in LABELS if each in curves):
            curve, ends = curves[name], [record["curve"][-1]["truth_ratio"] for record in runs[name]]
            rows.append([LABELS[name], "" if name in LEVELS else number(curve.x[-1], 0), with_spread(ends),
                         "" if name in LEVELS else number(curve.needed(target), 0), str(curve.seeds),
                         number(mean_of(runs[name], "cpu_s"), 0)])
        heads = ["", "real episodes", "collected at the end", f"real episodes to {target:.3f}", "seeds", "CPU s each"]
        text = f"**{shown(scene, truth)}**\n\n{markdown(heads, rows)}"
        parts.append(text + factors(curves, target))
    return "\n\n".join(parts) + (
        "\n\n±: standard deviation over seeds. \"Real episodes to\": the first round whose mean over seeds is as high; "
        f"the ratio is {ENOUGH:.0%} of what both model-aided FedQMIX and QMIX on real episodes reach at least. Rounds "
        "of training in the truth are 800 episodes and the flights that choose the policy, so there that column is an "
        "upper bound.")


def factors(curves: dict, target: float) -> str:
    """How many times as many real episodes QMIX needs without a twin."""
    real = curves["qmix-truth"].needed(target) if "qmix-truth" in curves else np.nan
    told = []
    for name in ("fedqmix-nn", "qmix-nn", "qmix-log-distance", "fedqmix-raytrace", "planner-nn", "planner-raytrace"):
        if name in curves and real == real:
            aided = curves[name].needed(target)
            told.append(f"{LABELS[name]} {aided:.0f} (a factor of {real / aided:,.0f})" if aided == aided else
                        f"{LABELS[name]} does not reach it in {curves[name].x[-1]:.0f}")
    return f"\n\nQMIX without a twin takes {real:,.0f} or fewer for {target:.3f}; {'; '.join(told)}." if told else ""


def common_ratio(curves: dict) -> float:
    """A ratio that the learners with and without a twin reach both."""
    tops = [curves[name].mean.max() for name in ("fedqmix-nn", "qmix-truth") if name in curves]
    return ENOUGH * float(min(tops)) if tops else np.nan


def federation_table(records: list[dict]) -> str:
    """FedQMIX and QMIX by simulated episodes."""
    parts = []
    for (_, scene), runs in worlds(records).items():
        rows = []
        for name, seeds in sorted(runs.items(), key=lambda item: item[1][0]["curve"][-1]["simulated_episodes"]):
            run = seeds[0]["settings"]["run"]
            rows.append([name, f"{run['episodes'] * run['real_episodes']:,}",
                         f"{seeds[0]['curve'][-1]['simulated_episodes']:,}",
                         number(mean_of(seeds, "cpu_s"), 0),
                         with_spread([record["curve"][-1]["truth_ratio"] for record in seeds]), str(len(seeds))])
        heads = ["", "episodes of a replica", "simulated in all", "CPU s", "collected", "seeds"]
        parts.append(f"**{scene}, statistical truth, 10 real episodes**\n\n{markdown(heads, rows)}")
    return "\n\n".join(parts) + (
        "\n\nEqual for a replica: `fedqmix-3x800` and `qmix-800` (equal time where there are three cores). Equal in "
        "all: `fedqmix-3x267` and `qmix-800`, `fedqmix-3x800` and `qmix-2400` (equal time on one core). Equal time on "
        "two cores: `fedqmix-3x800` and `qmix-1280`. `weights`: moments and target networks are not averaged.")


def twin_table(records: list[dict]) -> str:
    """What training and planning in each twin is worth."""
    parts = []
    for scene, runs in scenes(records).items():
        rows = []
        for name in (each for each in TWINS if each in runs):
            seeds = runs[name]
            found = [[record["fidelity"][key] for record in seeds] if "fidelity" in seeds[0] else []
                     for key in ("correlation", "bias", "device_correlation")]
            errors = [error for record in seeds for error in record.get("location_errors_m", [])]
            rows.append([TWINS[name], number(mean_of(seeds, "map_rmse_db"), 1),
                         "–" if not errors else "{:.1f} / {:.0f}".format(*quantiles(errors)[::2]),
                         *(with_spread(values, 2) for values in found),
                         *(with_spread([record[f"{who}_{where}_ratio"] for record in seeds])
                           for who in ("trained", "plan") for where in ("twin", "truth")), str(len(seeds))])
        heads = ["twin", "map RMSE [dB]", "position error, median / worst [m]", "correlation", "bias",
                 "correlation by device", "policy in the twin", "**policy in the truth**", "plan in the twin",
                 "**plan in the truth**", "seeds"]
        parts.append(f"**{scene}, ray-traced truth, five real flights**\n\n{markdown(heads, rows)}")
    return "\n\n".join(parts) + (
        "\n\nCorrelation and bias (twin less truth) of the share that 20 sequences of actions, from greedy to random, "
        "collect in both.")


def quality_table(records: list[dict]) -> str:
    """Map and positions by real episodes."""
    parts = []
    for scene, runs in scenes(records).items():
        rows = []
        for name in (each for each in MODELS if each in runs):
            for at, row in enumerate(runs[name][0]["curve"]):
                here = [record["curve"][at] for record in runs[name]]
                errors = [error for each in here for error in each["location_errors_m"]]
                median, most, worst, far = quantiles(errors)
                rows.append([MODELS[name], str(row["real_episodes"]),
                             " / ".join(number(mean_of(here, key), 1) for key in
                                        ("map_rmse_db", "map_rmse_los_db", "map_rmse_nlos_db")),
                             f"{median:.1f}", f"{most:.0f}", f"{worst:.0f}", f"{far:.0%}",
                             PUBLISHED.get((scene, row["real_episodes"]), "") if name == "segmented_nn" else "",
                             str(len(here))])
        heads = ["model", "real episodes", "map RMSE, all / LoS / NLoS [dB]", "position error, median [m]", "90 %",
                 "worst", "above 100 m", "published code, its map and truth", "seeds"]
        parts.append(f"**{scene}, ray-traced truth**\n\n{markdown(heads, rows)}")
    return "\n\n".join(parts)


def pays_table(records: list[dict]) -> str:
    """Scenarios against methods."""
    parts = []
    for scene, runs in scenes(records).items():
        names = [name for name in METHODS if any(run.endswith(f"-{name}") for run in runs)]
        rows = []
        for scenario in SCENARIOS:
            cells = [runs.get(f"{scenario}-{name}", []) for name in names]
            if any(cells):
                means = [np.mean([record["truth_ratio"] for record in seeds]) if seeds else np.nan for seeds in cells]
                rows.append([SCENARIOS[scenario], *(
                    ("**{}**" if mean == np.nanmax(means) else "{}").format(pooled(seeds))
                    for seeds, mean in zip(cells, means))])
        seeds = sorted({len(group) for group in runs.values()})
        parts.append(f"**{scene}, statistical truth** (64 flights a seed; seeds: {', '.join(map(str, seeds))})\n\n"
                     + markdown(["", *(METHODS[name] for name in names)], rows))
    return "\n\n".join(parts) + "\n\nMean ± standard deviation over flights."


def pooled(records: list[dict]) -> str:
    """Mean and standard deviation of all flights of all seeds."""
    return with_spread([ratio for record in records for ratio in record["ratios"]])


def tuning_table(records: list[dict]) -> str:
    """One change at a time."""
    parts = []
    for (truth, scene), runs in worlds(records).items():
        rows = [[options(seeds[0]["settings"]), with_spread([record["curve"][-1]["truth_ratio"] for record in seeds]),
                 with_spread([record["curve"][-1]["twin_ratio"] for record in seeds]),
                 number(np.mean([record["curve"][-1]["location_error_worst_m"] for record in seeds]), 0),
                 str(len(seeds))] for seeds in runs.values()]
        heads = ["options", "collected", "in the twin", "worst position error at the end [m]", "seeds"]
        parts.append(f"**{shown(scene, truth)}, model-aided QMIX**\n\n{markdown(heads, rows)}")
    return "\n\n".join(parts)


def options(settings: dict) -> str:
    """What of a run of Algorithm 1 differs from today's defaults, as options of `marl.fedqmix`."""
    defaults = RunSettings().model_dump(mode="json") | LearnerSettings().model_dump()
    now = filled(settings)
    given = [f"--{name.replace('_', '-')} {str(value).lower()}" for name, value in (now["run"] | now["learner"]).items()
             if name not in WORLD and value != defaults[name]]
    return f"`{' '.join(given)}`" if given else "as it is"


def provenance(records: list[dict]) -> str:
    """Where the numbers come from."""
    taken = sorted({record["taken_from"] for record in records if "taken_from" in record})
    versions = sorted({record["version"] + (f" ({record['code']})" if record["code"] else "") for record in records})
    machines = sorted({record["machine"] for record in records if record["machine"]})
    own = [record for record in records if "taken_from" not in record]
    hours = sum(record["cpu_s"] for record in own) / 3600
    text = (f"{len(records)} runs of {len(by_name(records))} kinds, {hours:.1f} CPU hours; version (hash of the "
            f"sources): {', '.join(versions)}; {', '.join(machines)}.")
    return text + (f" Taken from runs with the same settings: {', '.join(f'`{name}`' for name in taken)}."
                   if taken else "")
