"""The twin of a loop: fitted to all its links, with its base, all causes and what maps have."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

import radiotwin
from radiotwin.closeloop.predict.predictor import served
from radiotwin.closeloop.run import Loop
from radiotwin.scene import Scene
from radiotwin.twin.localize import RadiusCalibration, calibrate_radii, whole_area
from radiotwin.twin.shadowing import MAP_ERRORS, MapErrors
from radiotwin.twin.twin import Twin, measured_heights


def corrected_twin(loop: Loop, scene: Scene | None) -> Twin:
    """Return the twin of a loop; it predicts by the loop's combination.

    What belongs to a receiver (its offset, drift, antenna, …) is part of it, too; but a map is of
    what arrives at a faultless receiver.

    Args:
        loop: what was found.
        scene: that it was found in, if there was one.
    """
    model = loop.for_twin
    fitted = replace(served(model, loop.prediction.combination, loop.seed),
                     **vars(_calibration(loop, scene)))
    provenance: dict[str, Any] = {"links": len(model.links),
                                  "radiotwin_version": radiotwin.__version__}
    provenance |= measured_heights(model.links)
    residual_db = loop.links.level_db - loop.prediction.map_db
    sd_db = np.where(loop.links.los, *(_sd_db(residual_db[loop.links.los == los])
                                       for los in (True, False)))
    provenance[MAP_ERRORS] = asdict(MapErrors.of_residuals(
        loop.links.device, loop.links.receiver_m, residual_db, sd_db, loop.seed))
    if loop.origin is not None:
        provenance |= {"origin": loop.origin.model_dump()}
    if scene is not None:
        provenance |= {"scene": scene.config.name, "scene_hash": scene.content_hash()}
    # Devices whose position is too uncertain to be learnt from, too: a map with them is better.
    return replace(model.twin, provenance=provenance, fitted=fitted, scene=scene)


def _sd_db(residual_db: np.ndarray) -> float:
    """Return the standard deviation of those residuals that there are; 1 dB of hardly any."""
    known = residual_db[np.isfinite(residual_db)]
    return max(float(known.std()), 0.1) if len(known) > 1 else 1.0


def _calibration(loop: Loop, scene: Scene | None) -> RadiusCalibration:
    """Return how far positions are to be believed that folds locate as the twin does."""
    model, links = loop.for_twin, loop.links
    if model.whole.channel.follows_paths:  # which locates nothing: `check_can_locate`
        return RadiusCalibration()
    models = [fold.learnt.for_positions() for fold in model.folds]
    # A device that the loop found elsewhere is not where it was declared.
    moved = {device for each in model.whole.effects
             for device in each.correction(model.links).moves_m}
    known = links.with_ends(anchors=links.anchors - moved)
    held_out = [known.select(model.index == number) for number in range(len(models))]
    area_m = scene.config.extent.bounds if scene is not None else whole_area(models[0], links)
    return calibrate_radii(models, held_out, area_m, loop.seed)
