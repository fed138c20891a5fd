"""Twins that are more than a channel: with what the loop found, or with paths over the map. Saved in `twin.json`, and
applied wherever the twin predicts a map."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np

import radiotwin
from radiotwin.channel import ChannelModel
from radiotwin.closeloop.bases import FittedBase, FittedChannel, TwinBase
from radiotwin.closeloop.locate import Corrected, calibrated_temper, device_spread_db, whole_area
from radiotwin.closeloop.model import Side
from radiotwin.closeloop.raytraced import FittedPaths, RaytraceBase
from radiotwin.closeloop.records import Records, make_records
from radiotwin.closeloop.regression import Solution, nll
from radiotwin.closeloop.relocation import MOST_DEVICES
from radiotwin.closeloop.run import Loop
from radiotwin.closeloop.search import best_dof
from radiotwin.closeloop.shadowing import Shadowing
from radiotwin.effects import CATALOGUE
from radiotwin.effects.base import Effect
from radiotwin.errors import BadInput
from radiotwin.measurements import Measurements
from radiotwin.scene import Scene
from radiotwin.twin import Predictor, Twin, TwinDevice

CHUNK = 20_000  # links at once
LEAST_HEARD = 30  # links of a class of line of sight, to learn its level from
LEAST_LOST_NATS = 0.02  # a link, to be worse than the law, which has more numbers to be fitted


def corrected_twin(loop: Loop, scene: Scene | None) -> Twin:
    """The twin of a loop, fitted to all its links, with all effects.

    What belongs to a receiver (its offset, drift, antenna, …) is kept in the record, too, but a map is of what arrives
    at a faultless receiver.
    """
    more: dict[str, Any] = {"temper": _temper(loop)}
    if loop.after.shadowing:
        more["shadowing"] = loop.after.shadowing[0].state()
    return _twin(loop.base, loop.after.whole, loop.after.fits[0], scene, more)


def raytraced_twin(measurements: Measurements, scene: Scene, seed: int, start: Twin | None = None) -> Twin:
    """The twin that predicts by paths over the 3D map, with unknown devices where these explain the levels best.

    What these paths do not tell is learnt: a level for each class of line of sight, what reaches any place on ways that
    are not followed, and the errors' sizes.

    Args:
        measurements: links to anchors and unknown devices.
        scene: its map; all surfaces are taken to be concrete.
        seed: of the search by a law, which says where it is worth following paths.
        start: an earlier twin; what it was sure of is looked for around there only.

    Warns where paths explain the levels worse than the law.

    Raises:
        BadInput: no anchor, too few links, or links that nothing can be learned from.
    """
    records = make_records(measurements, scene)
    for remark in records.remarks:
        warnings.warn(remark, stacklevel=3)
    law = TwinBase(scene, seed)
    base = RaytraceBase(law, start, most_radius_m=np.inf).fit(records)
    dof, everything = best_dof(records, base), np.ones(len(records), dtype=bool)
    by_paths, by_law = (Side.make(records, everything, each, dof) for each in (base, law.fit(records)))
    fit, both = by_paths.fit(), by_paths.usable & by_law.usable
    heard = np.bincount(by_paths.group[by_paths.usable & np.isfinite(records.level_db)], minlength=2)
    lost = nll(by_paths.problem(both), fit).sum() - nll(by_law.problem(both), by_law.fit()).sum()
    if heard[0] >= LEAST_HEARD and lost > LEAST_LOST_NATS * both.sum():
        warnings.warn("paths over the 3D map explain these levels worse than a law of distance and line of sight does: "
                      "is the map that of the place, and in the same frame? Otherwise take the model segmented_nn",
                      stacklevel=3)
    if heard.min() < LEAST_HEARD <= heard.max():
        few, many = heard.argmin(), heard.argmax()
        warnings.warn(f"only {heard[few]} links {('without', 'with')[few]} line of sight were heard: their level is "
                      f"that of the others, {fit.coefficients[1 - many]:.1f} dB from what paths bring", stacklevel=3)
        fit = replace(fit, coefficients=np.full(2, fit.coefficients[1 - many]), scale_db=np.full(2, fit.scale_db[many]))
    unknown = sum(device.role == "unknown" for device in by_paths.base.found)
    if unknown > MOST_DEVICES:
        warnings.warn(f"{unknown} devices are unknown, and paths are followed to find {MOST_DEVICES} at most: they are "
                      "where a law of distance and line of sight has them", stacklevel=3)
    twin = _twin(RaytraceBase.name, by_paths, fit, scene, {"temper": 1.0})
    twin.provenance.update(flights=measurements.flights, seed=seed)
    return twin


def _twin(base: str, whole: Side, fit: Solution, scene: Scene | None, more: dict[str, Any]) -> Twin:
    records, law = whole.records, whole.base
    split = whole.base_columns.shape[1]
    parts = [{"name": part.effect.name, "variant": part.effect.variant, "setting": part.setting,
              "coefficients": fit.coefficients[place].tolist()}
             for part, place in zip(whole.parts, whole.places) if part.effect.explains]
    # Also devices whose place is too unsure to be learned from: a map with them is better than one without.
    devices = list(law.found) or [TwinDevice(name, float(x_m), float(y_m), float(z_m), "anchor", True, 0.0, None)
                                  for name, (x_m, y_m, z_m) in zip(records.device_names, law.device_m)]
    effects = {"base": base, "coefficients": fit.coefficients[:split].tolist(), "dof": whole.dof,
               "scale_db": fit.scale_db.tolist(), "receivers": records.receiver_names, "parts": parts,
               "first_s": None if np.isnan(records.first_s) else records.first_s,
               "device_spread_db": device_spread_db(whole, fit)} | more
    if isinstance(law, FittedPaths):
        effects["rest"] = list(law.rest)
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


def corrected_predictor(twin: Twin, scene: Scene) -> Predictor:
    """What a twin with effects expects of links in a scene, at receivers without faults of their own.

    Raises:
        BadInput: effects that this version does not know, or a twin that was made without a 3D map.
    """
    _require_same_map(twin, scene)
    found = twin.effects
    base: FittedBase = FittedChannel(twin.channel, twin.device_m)
    if found["base"] == RaytraceBase.name:
        base = FittedPaths(FittedChannel(twin.channel, twin.device_m), tuple(found["rest"]), twin.device_m)
    coefficients, error_db = np.array(found["coefficients"]), np.array(found["scale_db"])
    deviation_db = error_db * np.sqrt(found["dof"] / (found["dof"] - 2))
    parts = [(_effect(part["name"], part["variant"]), part) for part in found["parts"]]
    shadowing = Shadowing.from_state(found["shadowing"]) if "shadowing" in found else None

    def predict(receiver_m: np.ndarray, device: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        chunks = [slice(start, start + CHUNK) for start in range(0, max(len(device), 1), CHUNK)]
        told = [predict_some(_records(twin, scene, receiver_m[chunk], device[chunk])) for chunk in chunks]
        mean_db, sigma_db, los = (np.concatenate(values) for values in zip(*told))
        return mean_db, sigma_db, los

    def predict_some(records: Records) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        group = base.group(records)
        mean_db, sigma_db = _mean_db(base, records, coefficients, parts), deviation_db[group]
        if shadowing is not None and shadowing.receivers_move:
            shift, left = shadowing.at(records)
            mean_db, sigma_db = mean_db + shift * error_db[group], sigma_db * left
        return mean_db, sigma_db, records.los

    return predict


def described(twin: Twin) -> str:
    """The base and the effects of a twin in a few words."""
    names = [part["name"] for part in twin.effects["parts"]]
    names += ["correlated_shadowing"] * ("shadowing" in twin.effects)
    return twin.effects["base"] + (f" with {', '.join(names)}" if names else "")


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
                       "takes too long; `radiotwin fit --model raytrace` finds devices along with the twin, and "
                       "close-loop --base twin makes one for locate")
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


def _records(twin: Twin, scene: Scene, receiver_m: np.ndarray, device: np.ndarray) -> Records:
    """Links of nobody in particular: no receiver, no flight, no time."""
    n = len(receiver_m)
    nobody, unknown = np.full(n, -1), np.full(n, np.nan)
    anchors = frozenset(i for i, known in enumerate(twin.devices) if known.role == "anchor")
    return Records(unknown, twin.limit_db, receiver_m, np.nan_to_num(twin.device_m), device, nobody, nobody,
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
