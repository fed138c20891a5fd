"""Figures of the studies, from their records alone."""

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from marl.experiments.summaries import over_seeds, quantiles, scenes, shown, spread, worlds
from marl.experiments.tables import LABELS, LEVELS, METHODS, MODELS, SCENARIOS, TWINS
from marl.figures import COLOURS, LEVEL_STYLES, MARKERS

RATIO = "share of all data collected in the truth"


def curve_figure(records: list[dict]) -> Figure:
    """Collected data against real episodes, a panel for each truth and scene."""
    found = worlds(records)
    figure, panels = _figure(len(found), 2, 4.1)
    for axes, ((truth, scene), runs) in zip(panels, found.items()):
        for number, name in enumerate(name for name in LABELS if name not in LEVELS):
            if name in runs:
                _line(axes, over_seeds(runs[name]), LABELS[name], number)
        for style, name in zip(LEVEL_STYLES, LEVELS):
            if name in runs:
                axes.axhline(over_seeds(runs[name]).mean[-1], color="black", linestyle=style, linewidth=1.1,
                             label=LABELS[name])
        axes.set(xscale="log", ylim=(0, 1.02), xlabel="real episodes", ylabel=RATIO, title=shown(scene, truth))
        axes.grid(alpha=0.3)
    return _legend(figure, panels, 3)


def federation_figure(records: list[dict]) -> Figure:
    """Collected data over episodes of a replica, and over all."""
    found = worlds(records)
    figure, panels = _figure(2 * len(found), 2, 4.1)
    for row, ((truth, scene), runs) in enumerate(found.items()):
        for axes, share in zip(panels[2 * row:], (True, False)):
            for number, (name, seeds) in enumerate(sorted(runs.items())):
                curve = over_seeds(seeds, x="simulated_episodes")
                replicas = 3 if name.startswith("fedqmix") and share else 1
                _line(axes, curve._replace(x=curve.x / replicas), name, number)
            axes.set(xlabel="simulated episodes of a replica" if share else "simulated episodes of all replicas",
                     ylabel=RATIO, title=shown(scene, truth))
            axes.grid(alpha=0.3)
    return _legend(figure, panels, 3)


def twin_figure(records: list[dict]) -> Figure:
    """What policy and plan collect in the truth, by the twin that they were made in."""
    found = scenes(records)
    figure, panels = _figure(len(found), 2, 4.1)
    for axes, (scene, runs) in zip(panels, found.items()):
        names = [name for name in TWINS if name in runs]
        for number, (key, label) in enumerate((("trained", "policy (QMIX)"), ("plan", "planner"))):
            values = [[record[f"{key}_truth_ratio"] for record in runs[name]] for name in names]
            _bars(axes, number, 2, [np.mean(each) for each in values], [float(spread(each)) for each in values], label)
        axes.set(xticks=range(len(names)), ylim=(0, 1.02), ylabel=RATIO, title=f"{scene}, ray-traced truth",
                 xlabel="twin that it was trained or planned in")
        axes.set_xticklabels([name.replace("-", "-\n") for name in names])
        axes.grid(alpha=0.3, axis="y")
    return _legend(figure, panels, 2)


def quality_figure(records: list[dict]) -> Figure:
    """Error of the map and of positions against real episodes."""
    found = scenes(records)
    figure, panels = _figure(2 * len(found), 2, 3.8)
    for row, (scene, runs) in enumerate(found.items()):
        left, right = panels[2 * row:2 * row + 2]
        episodes: set[float] = set()
        for number, name in enumerate(name for name in MODELS if name in runs):
            curve, colour = over_seeds(runs[name], y="map_rmse_db"), COLOURS[number]
            _line(left, curve, MODELS[name], number)
            episodes |= set(curve.x)
            errors = [quantiles([error for record in runs[name] for error in record["curve"][at]["location_errors_m"]])
                      for at in range(len(curve.x))]
            right.plot(curve.x, [each[0] for each in errors], marker=MARKERS[number], markersize=4, color=colour)
            right.plot(curve.x, [each[1] for each in errors], ":", color=colour)
        left.set(ylabel="RMSE of the map [dB]", ylim=(0, None))
        right.set(ylabel="error of positions [m]: median, dotted 90 %", yscale="log")
        for axes in (left, right):
            axes.set(xlabel="real episodes", xscale="log", title=f"{scene}, ray-traced truth")
            axes.set_xticks(sorted(episodes), [f"{x:.0f}" for x in sorted(episodes)], minor=False)
            axes.set_xticks([], minor=True)
            axes.grid(alpha=0.3)
    return _legend(figure, panels, 3)


def pays_figure(records: list[dict]) -> Figure:
    """Scenarios, a bar for each method; lines are the standard error of the mean of the flights."""
    found = scenes(records)
    figure, panels = _figure(len(found), 1, 3.8)
    for axes, (scene, runs) in zip(panels, found.items()):
        names = [name for name in METHODS if any(run.endswith(f"-{name}") for run in runs)]
        scenarios = [each for each in SCENARIOS if any(run.startswith(each) for run in runs)]
        for number, name in enumerate(names):
            flights = [[ratio for record in runs.get(f"{scenario}-{name}", []) for ratio in record["ratios"]]
                       for scenario in scenarios]
            _bars(axes, number, len(names), [np.mean(each) if each else np.nan for each in flights],
                  [np.std(each) / np.sqrt(len(each)) if each else 0 for each in flights], METHODS[name])
        axes.set(xticks=range(len(scenarios)), ylim=(0, 1.02), ylabel=RATIO, xlabel="what is not as it was thought",
                 title=f"{scene}, statistical truth")
        axes.set_xticklabels([SCENARIOS[each] for each in scenarios])
        axes.grid(alpha=0.3, axis="y")
    return _legend(figure, panels, 3)


def _figure(panels: int, columns: int, height_in: float) -> tuple[Figure, list]:
    columns = min(columns, panels)
    rows = -(-panels // columns)
    figure = Figure(figsize=(10.0, height_in * rows + 0.9), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for unused in axes[panels:]:
        unused.remove()
    return figure, list(axes[:panels])


def _line(axes, curve, label: str, number: int) -> None:
    colour = COLOURS[number % len(COLOURS)]
    alone = {"markersize": 9, "markeredgecolor": "black"} if len(curve.x) == 1 else {"markersize": 4}
    axes.plot(curve.x, curve.mean, marker=MARKERS[number % len(MARKERS)], color=colour, label=label, **alone)
    axes.fill_between(curve.x, curve.mean - curve.spread, curve.mean + curve.spread, color=colour, alpha=0.18,
                      linewidth=0)


def _bars(axes, number: int, of: int, means: list[float], spreads: list[float], label: str) -> None:
    width = 0.8 / of
    axes.bar(np.arange(len(means)) + (number - (of - 1) / 2) * width, means, width * 0.92, yerr=spreads,
             color=COLOURS[number % len(COLOURS)], error_kw={"linewidth": 1}, label=label)


def _legend(figure: Figure, panels: list, columns: int) -> Figure:
    entries = {label: handle for axes in panels for handle, label in zip(*axes.get_legend_handles_labels())}
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=columns, frameon=False)
    return figure
