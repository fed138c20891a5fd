"""Make the corrected twin of a loop: its base with all effects, fitted to all links."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import numpy as np

import radiotwin
from radiotwin.closeloop.predict.predictor import combined_fit
from radiotwin.closeloop.run import Loop
from radiotwin.scene import Scene
from radiotwin.twin.localize import RadiusCalibration, calibrate_radii, whole_area
from radiotwin.twin.shadowing import MAP_ERRORS, ErrorCorrelation
from radiotwin.twin.twin import Twin, measured_heights


def corrected_twin(loop: Loop, scene: Scene | None) -> Twin:
    """Return the twin of a loop, which predicts by the loop's combination of models.

    It includes effects of receivers (offsets, drift, antennas), but its map is for a faultless
    receiver.

    Args:
        loop: result of the loop.
        scene: its scene; None if there was none.
    """
    model = loop.for_twin
    fitted = replace(combined_fit(model, loop.prediction.combination, loop.seed),
                     **vars(_calibration(loop, scene)))
    provenance: dict[str, Any] = {"links": len(model.links),
                                  "radiotwin_version": radiotwin.__version__}
    provenance |= measured_heights(model.links)
    residual_db = loop.links.level_db - loop.prediction.map_db
    sd_db = np.where(loop.links.los, *(_sd_db(residual_db[loop.links.los == los])
                                       for los in (True, False)))
    provenance[MAP_ERRORS] = asdict(ErrorCorrelation.of_residuals(
        loop.links.device, loop.links.receiver_m, residual_db, sd_db, loop.seed))
    if loop.origin is not None:
        provenance |= {"origin": loop.origin.model_dump()}
    if scene is not None:
        provenance |= {"scene": scene.config.name, "scene_hash": scene.content_hash()}
    # Devices too uncertain to learn from are included, so that the map shows them.
    return replace(model.twin, provenance=provenance, fitted=fitted, scene=scene)


def _sd_db(residual_db: np.ndarray) -> float:
    """Return the standard deviation of known residuals (n,), at least 0.1 dB; 1 dB of under two."""
    known = residual_db[np.isfinite(residual_db)]
    return max(float(known.std()), 0.1) if len(known) > 1 else 1.0


def _calibration(loop: Loop, scene: Scene | None) -> RadiusCalibration:
    """Calibrate the credible radii of located devices on anchors that folds hold out."""
    model, links = loop.for_twin, loop.links
    if model.whole.channel.follows_paths:  # `locate` does not use it
        return RadiusCalibration()
    models = [fold.learnt.for_positions() for fold in model.folds]
    # Anchors that the loop found elsewhere are not at their declared position.
    moved = {device for each in model.whole.effects
             for device in each.correction(model.links).moves_m}
    known = links.with_ends(anchors=links.anchors - moved)
    held_out = [known.select(model.index == number) for number in range(len(models))]
    area_m = scene.config.extent.bounds if scene is not None else whole_area(models[0], links)
    return calibrate_radii(models, held_out, area_m, loop.seed)
