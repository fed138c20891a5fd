"""Draw a comparison of models: maps, held-out links and located devices."""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from radiotwin.compare import Comparison
from radiotwin.display.style import plain
from radiotwin.radiomap import RadioMap
from radiotwin.report.labels import MODELS
from radiotwin.report.map_figures import model_maps_figure, panels, true_positions_m
from radiotwin.report.style import LOS_COLOUR, NLOS_COLOUR, save
from radiotwin.scene import Scene
from radiotwin.scene.preview import draw_heights, height_grid

MAX_COLUMNS = 5  # panels in a row
SHOWN = ("log_distance", "segmented_nn")  # models with maps and located devices


def write_comparison_figures(comparison: Comparison, scene: Scene, truth: RadioMap | None,
                             folder: Path | str) -> None:
    """Write the figures of a comparison as PNG files.

    Args:
        comparison: result of `compare_models`.
        scene: whose buildings are drawn.
        truth: map of reference gains; None: no maps are drawn.
        folder: for `scatter.png`, `estimates.png` where all true positions are known, and
            `maps.png`.
    """
    folder = Path(folder)
    save(scatter_figure(comparison, list(comparison.twins)), folder / "scatter.png")
    shown = [name for name in SHOWN if name in comparison.twins] or list(comparison.twins)[:2]
    if len(comparison.locations) and comparison.locations["error_m"].notna().all():
        save(estimates_figure(comparison, shown, scene), folder / "estimates.png")
    if truth is not None:
        maps = {name: comparison.twins[name].radio_map(scene) for name in reversed(shown)}
        figure = model_maps_figure(truth, maps, scene, typical_device(truth, maps))
        save(figure, folder / "maps.png")


def typical_device(truth: RadioMap, maps: dict[str, RadioMap]) -> str:
    """Return the device in all maps whose share of line of sight is nearest to the mean."""
    devices = [name for name in truth.devices
               if all(name in radio_map.devices for radio_map in maps.values())]
    los = np.array([truth.los[truth.devices.index(name)].mean() for name in devices])
    return devices[int(np.abs(los - los.mean()).argmin())]


def scatter_figure(comparison: Comparison, models: list[str]) -> Figure:
    """Draw predicted over measured levels of the held-out links, LoS and NLoS apart.

    Args:
        comparison: with its held-out predictions.
        models: names of the models, a panel for each.
    """
    columns = min(len(models), MAX_COLUMNS)
    figure, axes = panels(-(-len(models) // columns), columns, 4.2, 4.6)
    for unused in axes.flat[len(models):]:
        unused.set_visible(False)
    links = comparison.predictions.dropna(subset=["measured_db"])
    levels_db = [links["measured_db"], *(links[model].dropna() for model in models)]
    both_db = np.concatenate(levels_db)
    ends_db = np.floor(both_db.min() / 5) * 5, np.ceil(both_db.max() / 5) * 5
    for ax, model in zip(axes.flat, models):
        for los, colour, label in ((False, NLOS_COLOUR, "NLoS"), (True, LOS_COLOUR, "LoS")):
            part = links[links["los"] == los]
            ax.plot(part["measured_db"], part[model], ".", color=colour, markersize=3, alpha=0.5,
                    label=label)
        ax.plot(ends_db, ends_db, color="black", linewidth=0.8)
        error_db = (links[model] - links["measured_db"]).dropna()
        rmse_db = np.sqrt(np.mean(error_db**2))
        ax.set(title=f"{plain(MODELS.get(model, model))}, RMSE {rmse_db:.1f} dB", aspect="equal",
               xlabel="measured [dB]", ylabel="predicted [dB]", xlim=ends_db, ylim=ends_db)
        ax.grid(alpha=0.25)
        ax.legend(markerscale=4, loc="upper left")
    return figure


def estimates_figure(comparison: Comparison, models: list[str], scene: Scene) -> Figure:
    """Draw the estimated positions of the unknown devices; circles contain 90 % of the posterior.

    Args:
        comparison: with its located devices.
        models: names of the models, a panel for each.
        scene: whose buildings and true positions are drawn.
    """
    extent = scene.config.extent
    ratio = (extent.x_max_m - extent.x_min_m) / (extent.y_max_m - extent.y_min_m)
    figure, axes = panels(1, len(models), 6.4 * min(max(ratio, 0.7), 1.4), 6.4)
    height_m, bounds = height_grid(scene, 500)
    true_m = true_positions_m(scene)
    max_radius_m = 2 * (bounds[1] - bounds[0])
    for ax, model in zip(axes.flat, models):
        image = draw_heights(ax, height_m, bounds)
        for device in comparison.twins[model].devices:
            if device.role == "anchor":
                ax.plot(device.x_m, device.y_m, "^", color="black", markersize=8, label="anchor")
                continue
            x_m, y_m, _ = true_m[device.device]
            ax.plot(x_m, y_m, "*", color="#f08a00", markersize=14, markeredgecolor="white",
                    label="true position")
            if np.isfinite([device.x_m, device.y_m]).all():
                ax.plot([x_m, device.x_m], [y_m, device.y_m], color=NLOS_COLOUR, linewidth=1)
                ax.plot(device.x_m, device.y_m, "x", color=NLOS_COLOUR, markersize=8,
                        markeredgewidth=2, label="estimate")
                radius_m = min(device.credible_radius_m, max_radius_m)
                ax.add_artist(Circle((device.x_m, device.y_m), radius_m, fill=False,
                                     color=NLOS_COLOUR, linewidth=1, alpha=0.8))
        errors_m = comparison.locations.query("model == @model")["error_m"]
        ax.set_title(f"{plain(MODELS.get(model, model))}: median error {errors_m.median():.1f} m")
        ax.set(xlim=bounds[:2], ylim=bounds[2:])
    handles = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels())))
    figure.colorbar(image, ax=axes, label="height [m]", shrink=0.8)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3,
                  frameon=False)
    return figure
