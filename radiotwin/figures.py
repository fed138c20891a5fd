"""Figures of radio maps and of comparisons, drawn without a screen."""

from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from radiotwin.compare import Comparison, comparable_db
from radiotwin.files import atomic_path
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.scene.preview import draw_heights, height_grid

GAIN_COLOURS = "viridis"
DIFFERENCE_COLOURS = "RdBu_r"
LABELS = {"log_distance": "log-distance", "segmented_log_distance": "segmented log-distance",
          "segmented_nn": "segmented NN", "regression_kriging": "regression kriging"}
LOS_COLOUR, NLOS_COLOUR = "#2a7f9e", "#d1495b"
DPI = 110


def draw_radio_map(radio_map: RadioMap, scene: Scene, path: Path | str) -> None:
    """Gain of every device at the lowest altitude, with the buildings' outlines.

    Args:
        radio_map: to draw.
        scene: whose city is outlined.
        path: of the PNG file.
    """
    names, gain_db = radio_map.devices, radio_map.gain_db[:, 0]
    columns = min(len(names), 5)
    rows = -(-len(names) // columns)
    x_min, x_max, y_min, y_max = scene.config.extent.bounds
    figure, axes = _figure(rows, columns, 2.6, 0.6 + 2.3 * (y_max - y_min) / (x_max - x_min))
    low_db, high_db = np.nanquantile(gain_db, [0.01, 0.995]) if np.isfinite(gain_db).any() else (-1.0, 0.0)
    outline = height_grid(scene, 400)
    positions = dict(zip([d.device for d in scene.config.devices], scene.device_m))
    for number, ax in enumerate(axes.flat):
        if number >= len(names):
            ax.set_axis_off()
            continue
        image = _draw_level(ax, gain_db[number], radio_map, outline, GAIN_COLOURS, low_db, high_db)
        if names[number] in positions:
            ax.plot(*positions[names[number]][:2], "^", color="white", markeredgecolor="black", markersize=8)
        ax.set_title(names[number], fontsize=10)
        if number % columns:
            ax.set(ylabel="", yticklabels=[])
        if number + columns < len(names):
            ax.set(xlabel="", xticklabels=[])
    figure.colorbar(image, ax=axes, label="channel gain [dB]", shrink=0.7)
    figure.suptitle(f"{radio_map.dataset.attrs.get('source', '')} at {radio_map.lattice.z_m[0]:g} m")
    _save(figure, path)


def draw_maps(truth: RadioMap, models: dict[str, RadioMap], scene: Scene, device: str, path: Path | str) -> None:
    """The truth beside the models for one device at the lowest altitude, and what each model gets wrong.

    Args:
        truth: gains to judge by.
        models: name -> map with that device.
        scene: whose city is outlined.
        device: its name.
        path: of the PNG file.
    """
    figure, axes = _figure(2, 1 + len(models), 4.0, 4.3)
    outline = height_grid(scene, 400)
    true_db = truth.gain_db[truth.devices.index(device), 0]
    detected = true_db[np.isfinite(true_db)]
    low_db, high_db = np.quantile(detected, [0.01, 0.995]) if len(detected) else (-1.0, 0.0)
    gain_image = _draw_level(axes[0, 0], true_db, truth, outline, GAIN_COLOURS, low_db, high_db)
    axes[0, 0].set_title("truth")
    axes[1, 0].set_axis_off()
    axes[1, 0].text(0.02, 0.5, f"device {device}\nat {truth.lattice.z_m[0]:g} m altitude\n\ntop: channel gain\n"
                    "bottom: model − truth\n\nwhite: not detected\n\nmodels: the mean of\nwhat is detected",
                    transform=axes[1, 0].transAxes, fontsize=11)
    for column, (name, radio_map) in enumerate(models.items(), start=1):
        model_db = comparable_db(radio_map, truth)[radio_map.devices.index(device), 0]
        _draw_level(axes[0, column], model_db, radio_map, outline, GAIN_COLOURS, low_db, high_db)
        axes[0, column].set_title(LABELS.get(name, name))
        error_db = model_db - true_db
        error_image = _draw_level(axes[1, column], error_db, truth, outline, DIFFERENCE_COLOURS, -25, 25)
        axes[1, column].set_title(f"difference, RMSE {np.sqrt(np.nanmean(error_db**2)):.1f} dB", fontsize=10)
    true_m = dict(zip([d.device for d in scene.config.devices], scene.device_m))
    for ax in (*axes[0], *axes[1, 1:]):
        if device in true_m:
            ax.plot(*true_m[device][:2], "^", color="white", markeredgecolor="black", markersize=9)
    figure.colorbar(gain_image, ax=axes[0], label="channel gain [dB]", shrink=0.85)
    figure.colorbar(error_image, ax=axes[1], label="model − truth [dB]", shrink=0.85, extend="both")
    _save(figure, path)


def draw_scatter(comparison: Comparison, models: list[str], path: Path | str) -> None:
    """Measured against predicted level of the held-out links, LoS and NLoS apart.

    Args:
        comparison: with its held-out predictions.
        models: columns to draw.
        path: of the PNG file.
    """
    figure, axes = _figure(1, len(models), 4.2, 4.6)
    links = comparison.predictions.dropna(subset=["measured_db"])
    both = np.concatenate([links["measured_db"], *(links[model].dropna() for model in models)])
    low_db, high_db = np.floor(both.min() / 5) * 5, np.ceil(both.max() / 5) * 5
    for ax, model in zip(axes.flat, models):
        for los, colour, label in ((False, NLOS_COLOUR, "NLoS"), (True, LOS_COLOUR, "LoS")):
            part = links[links["los"] == los]
            ax.plot(part["measured_db"], part[model], ".", color=colour, markersize=3, alpha=0.5, label=label)
        ax.plot([low_db, high_db], [low_db, high_db], color="black", linewidth=0.8)
        error_db = (links[model] - links["measured_db"]).dropna()
        ax.set(title=f"{LABELS.get(model, model)}, RMSE {np.sqrt(np.mean(error_db**2)):.1f} dB", aspect="equal",
               xlabel="measured [dB]", ylabel="predicted [dB]", xlim=(low_db, high_db), ylim=(low_db, high_db))
        ax.grid(alpha=0.25)
        ax.legend(markerscale=4, loc="upper left")
    _save(figure, path)


def draw_estimates(comparison: Comparison, models: list[str], scene: Scene, path: Path | str) -> None:
    """Where each model puts the unknown devices, on the city; the circle holds 90 % of the posterior.

    Args:
        comparison: with its located devices.
        models: one panel each.
        scene: whose city and true positions are drawn.
        path: of the PNG file.
    """
    width = (scene.config.extent.x_max_m - scene.config.extent.x_min_m) / (
        scene.config.extent.y_max_m - scene.config.extent.y_min_m)
    figure, axes = _figure(1, len(models), 6.4 * min(max(width, 0.7), 1.4), 6.4)
    height_m, bounds = height_grid(scene, 500)
    true_m = dict(zip([d.device for d in scene.config.devices], scene.device_m))
    for ax, model in zip(axes.flat, models):
        image = draw_heights(ax, height_m, bounds)
        for device in comparison.twins[model].devices:
            if device.role == "anchor":
                ax.plot(device.x_m, device.y_m, "^", color="black", markersize=8, label="anchor")
                continue
            x_m, y_m, _ = true_m[device.device]
            ax.plot(x_m, y_m, "*", color="#f08a00", markersize=14, markeredgecolor="white", label="true position")
            if np.isfinite([device.x_m, device.y_m]).all():
                ax.plot([x_m, device.x_m], [y_m, device.y_m], color=NLOS_COLOUR, linewidth=1)
                ax.plot(device.x_m, device.y_m, "x", color=NLOS_COLOUR, markersize=8, markeredgewidth=2,
                        label="estimate")
                ax.add_artist(_circle(device, 2 * (bounds[1] - bounds[0])))
        errors = comparison.locations.query("model == @model")["error_m"]
        ax.set_title(f"{LABELS.get(model, model)}: median error {errors.median():.1f} m")
        ax.set(xlim=bounds[:2], ylim=bounds[2:])
    handles = dict(zip(*reversed(axes[0, 0].get_legend_handles_labels())))
    figure.colorbar(image, ax=axes, label="height [m]", shrink=0.8)
    figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=3, frameon=False)
    _save(figure, path)


def _circle(device, largest_m: float):
    from matplotlib.patches import Circle

    return Circle((device.x_m, device.y_m), min(device.credible_radius_m, largest_m), fill=False, color=NLOS_COLOUR,
                  linewidth=1, alpha=0.8)


def _draw_level(ax, values, radio_map: RadioMap, outline, colours, low, high):
    lattice = radio_map.lattice
    half_m = lattice.step_m / 2
    extent = (lattice.x_m[0] - half_m, lattice.x_m[-1] + half_m, lattice.y_m[0] - half_m, lattice.y_m[-1] + half_m)
    image = ax.imshow(values, origin="lower", extent=extent, cmap=colours, vmin=low, vmax=high,
                      interpolation="nearest")
    height_m, bounds = outline
    ax.contour(height_m > 2.0, levels=[0.5], origin="lower", extent=bounds, colors="black", linewidths=0.4, alpha=0.5)
    ax.set(xlabel="x, east [m]", ylabel="y, north [m]", aspect="equal")
    return image


def _figure(rows: int, columns: int, width_in: float, height_in: float):
    figure = Figure(figsize=(width_in * columns + 1.2, height_in * rows), layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.subplots(rows, columns, squeeze=False)


def _save(figure: Figure, path: Path | str) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=DPI)
