"""The twin with what the loop found in it: saved in `twin.json`, and applied wherever the twin predicts a map."""

from typing import Any

import numpy as np

import radiotwin
from radiotwin.channel import ChannelModel
from radiotwin.closeloop.bases import FittedBase, FittedChannel
from radiotwin.closeloop.locate import Corrected, calibrated_temper, device_spread_db, whole_area
from radiotwin.closeloop.raytraced import FittedPaths
from radiotwin.closeloop.records import Records
from radiotwin.closeloop.regression import Solution
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.shadowing import Shadowing
from radiotwin.effects import CATALOGUE
from radiotwin.effects.base import Effect
from radiotwin.errors import BadInput
from radiotwin.progress import progress
from radiotwin.radiomap import RadioMap
from radiotwin.scene import Scene
from radiotwin.twin import Twin, TwinDevice

CHUNK = 20_000  # links at once


def corrected_twin(loop: Loop, scene: Scene | None) -> Twin:
    """The twin of a loop, fitted to all its links, with all effects.

    What belongs to a receiver (its offset, drift, antenna, …) is kept in the record, too, but a map is of what arrives
    at a faultless receiver.
    """
    whole, fit = loop.after.whole, loop.after.fits[0]
    records, law = whole.records, whole.base
    split = whole.base_columns.shape[1]
    parts = [{"name": part.effect.name, "variant": part.effect.variant, "setting": part.setting,
              "coefficients": fit.coefficients[place].tolist()}
             for part, place in zip(whole.parts, whole.places) if part.effect.explains]
    # Also devices whose place is too unsure to be learned from: a map with them is better than one without.
    devices = list(law.found) or [TwinDevice(name, float(x_m), float(y_m), float(z_m), "anchor", True, 0.0, None)
                                  for name, (x_m, y_m, z_m) in zip(records.device_names, law.device_m)]
    effects = {"base": loop.base, "coefficients": fit.coefficients[:split].tolist(), "dof": whole.dof,
               "scale_db": fit.scale_db.tolist(), "receivers": records.receiver_names, "parts": parts,
               "first_s": None if np.isnan(records.first_s) else records.first_s,
               "device_spread_db": device_spread_db(whole, fit), "temper": _temper(loop)}
    if isinstance(law, FittedPaths):
        effects["rest"] = list(law.rest)
    if loop.after.shadowing:
        effects["shadowing"] = loop.after.shadowing[0].state()
    provenance = {"links": len(records), "radiotwin_version": radiotwin.__version__}
    if scene is not None:
        provenance |= {"scene": scene.config.name, "scene_hash": scene.content_hash()}
    return Twin(_channel(law), devices, "gain_db" if records.is_gain else "rssi_dbm", records.limit_db, provenance,
                effects)


def _temper(loop: Loop) -> float:
    """How sure the likelihood may be of places where there is no map; with one, `radiotwin fit` finds devices."""
    model, records = loop.after, loop.records
    if records.city is not None:
        return 1.0
    models = [Corrected.of(side, fit) for side, fit in zip(model.folds, model.fits[1:])]
    held_out = [records.select(model.index == number) for number in range(len(models))]
    return calibrated_temper(models, held_out, whole_area(models[0], records), 0)


def corrected_map(twin: Twin, scene: Scene) -> RadioMap:
    """What a twin with effects predicts over a scene's lattice.

    Raises:
        BadInput: effects that this version does not know, or a twin that was made without a 3D map.
    """
    _require_same_map(twin, scene)
    found = twin.effects
    base: FittedBase = FittedChannel(twin.channel, twin.device_m)
    if found["base"] == "raytrace":
        base = FittedPaths(FittedChannel(twin.channel, twin.device_m), tuple(found["rest"]), twin.device_m)
    parts = [(_effect(part["name"], part["variant"]), part) for part in found["parts"]]
    shadowing = Shadowing.from_state(found["shadowing"]) if "shadowing" in found else None
    known = np.flatnonzero(np.isfinite(twin.device_m).all(axis=1))
    receiver_m = scene.lattice.positions_m
    shape = (len(known), len(receiver_m))
    mean_db, sigma_db, los = np.empty(shape), np.empty(shape), np.empty(shape, dtype=bool)
    scale_db = np.array(found["scale_db"]) * np.sqrt(found["dof"] / (found["dof"] - 2))
    with progress("mapping", total=len(known)) as advance:
        for row, device in enumerate(known):
            for start in range(0, len(receiver_m), CHUNK):
                place = slice(start, start + CHUNK)
                records = _records(twin, scene, receiver_m[place], int(device))
                group = base.group(records)
                mean_db[row, place] = _mean_db(base, records, np.array(found["coefficients"]), parts)
                sigma_db[row, place] = scale_db[group]
                if shadowing is not None and shadowing.receivers_move:
                    shift, left = shadowing.at(records)
                    mean_db[row, place] += shift * np.array(found["scale_db"])[group]
                    sigma_db[row, place] *= left
                los[row, place] = records.los
            advance(1)
    if twin.level == "rssi_dbm":
        mean_db -= scene.config.radio.tx_power_dbm
    names = [part["name"] for part in found["parts"]] + ["correlated_shadowing"] * (shadowing is not None)
    attributes = {"source": f"twin:{found['base']} with {', '.join(names) or 'nothing'}",
                  "frequency_hz": scene.config.radio.frequency_hz, "gain_limit_db": scene.config.gain_limit_db,
                  "scene_hash": scene.content_hash(), "radiotwin_version": radiotwin.__version__}
    return RadioMap.build([twin.devices[i].device for i in known], scene.lattice, mean_db, los, sigma_db, attributes)


def corrected_model(twin: Twin, scene: Scene | None) -> Corrected:
    """What `locate` needs of a twin with effects.

    Args:
        twin: of `close-loop`.
        scene: the 3D map that devices are to be located with.

    Raises:
        BadInput: no effects, or some that this version does not know, or a base that follows paths, or a scene where
            the twin was made without one, or the other way round.
    """
    found = twin.effects
    if not found or "temper" not in found:
        raise BadInput("the twin was not made by `radiotwin close-loop`, or by an earlier version of it; run that on "
                       "measurements of devices whose positions are known")
    if found["base"] == "raytrace":
        raise BadInput("the twin's base is 'raytrace', and to follow paths from every place where a device may be "
                       "takes too long; close the loop with --base twin")
    _require_same_map(twin, scene)
    parts = [(_effect(part["name"], part["variant"]), part) for part in found["parts"]]
    coefficients = np.concatenate([found["coefficients"], *(part["coefficients"] for _, part in parts)])
    solution = Solution(coefficients, np.array(found["scale_db"]), np.nan)
    return Corrected(FittedChannel(twin.channel, twin.device_m), [(effect, part["setting"]) for effect, part in parts],
                     solution, found["dof"], np.nan_to_num(twin.device_m),
                     np.nan if found["first_s"] is None else found["first_s"], found["device_spread_db"],
                     found["temper"])


def _require_same_map(twin: Twin, scene: Scene | None) -> None:
    """A law that was fitted to each class of line of sight needs a map, and one that was not can do nothing with it."""
    if twin.effects["base"] == "raytrace" or not twin.channel.uses_map:
        return
    with_map = len(twin.effects["coefficients"]) > 2  # a level and a slope for each class
    if with_map and scene is None:
        raise BadInput(f"the twin was made with a 3D map (scene {twin.provenance.get('scene', 'unknown')}), and none "
                       "is given; give it with --scene")
    if scene is not None and not with_map:
        raise BadInput(f"the twin was made without a 3D map, and cannot use that of {scene.folder}: locate devices "
                       "without --scene, or run close-loop with --scene first")


def _mean_db(base: FittedBase, records: Records, coefficients: np.ndarray,
             parts: list[tuple[Effect, dict]]) -> np.ndarray:
    level_db = base.mean_db(records) + base.columns(records)[0] @ coefficients
    gain_db = np.zeros(len(records))
    for effect, part in parts:
        if effect.of_receiver:
            continue
        term = effect.term(records, part["setting"], base.shifted_db)
        if effect.stage == "paths":
            level_db, _ = effect.bend(level_db, part["setting"], term.extra)
        gain_db += term.offset_db + term.columns @ np.array(part["coefficients"])
    return level_db + gain_db


def _records(twin: Twin, scene: Scene, receiver_m: np.ndarray, device: int) -> Records:
    """Links of nobody in particular: no receiver, no flight, no time."""
    n = len(receiver_m)
    nobody, unknown = np.full(n, -1), np.full(n, np.nan)
    anchors = frozenset(i for i, known in enumerate(twin.devices) if known.role == "anchor")
    return Records(unknown, twin.limit_db, receiver_m, np.nan_to_num(twin.device_m), np.full(n, device), nobody, nobody,
                   unknown, unknown, [known.device for known in twin.devices], [], [],
                   scene.config.radio.frequency_hz, scene.city, twin.level == "gain_db", anchors)


def _effect(name: str, variant: str) -> Effect:
    for effect in CATALOGUE:
        if (effect.name, effect.variant) == (name, variant):
            return effect()
    raise BadInput(f"the twin has the effect {name!r} ({variant}), which this version of radiotwin does not know; it "
                   f"knows {', '.join(sorted({effect.name for effect in CATALOGUE}))}")


def _channel(base: FittedBase) -> ChannelModel:
    law: Any = base.law if isinstance(base, FittedPaths) else base
    return law.channel
