"""Is evidence what it claims to be? Laplace's approximation against nested sampling: `nested`.

Ten campaigns over open ground with something hidden in them, plain to see or less. For each the
evidence that `close-loop` weighs (radiotwin/closeloop/verdict/hypotheses.py), and that of nested
sampling over the effect's numbers and the two variances of the rest: exact levels at every draw,
dense matrices, and a library of its own (dynesty; Speagle 2020, MNRAS 493). `pip install
dynesty==3.1.0`.
"""

from collections.abc import Callable
from types import SimpleNamespace

import numpy as np
import pandas as pd
from scipy.linalg import cho_factor, solve_triangular
from scipy.spatial.distance import cdist

from radiotwin.closeloop.crossfit import LogDistanceBase, cross_validate, make_folds, training_parts
from radiotwin.closeloop.verdict.hypotheses import Hypotheses
from radiotwin.effects.base import Effect
from radiotwin.effects.catalogue.body_shadowing import BodyShadowing
from radiotwin.effects.catalogue.clock_offset import ReceiverClockOffset
from radiotwin.effects.catalogue.foliage import Foliage
from radiotwin.effects.catalogue.interference import Interference
from radiotwin.effects.catalogue.position_errors import DevicePositionError
from radiotwin.inference.censored_regression import FitResult
from radiotwin.inference.correlated_evidence import BOUNDS
from radiotwin.links import prepare_links
from radiotwin.twin.model.fitting import add_effect
from radiotwin.twin.model.model import Fit
from studies.runner import Study
from studies.tables import markdown
from tests import worlds

LIVE_POINTS = 200
EVERY = 9  # of how many slots one is kept: dense matrices are slow
CASES = {"a clock, 8 s": ("late", 8), "a clock, 4 s": ("late", 4),
         "an anchor, 100 m off": ("moved", 100.0), "an anchor, 60 m off": ("moved", 60.0),
         "a grove, 15 dB": ("grove", 15.0), "a grove, 10 dB": ("grove", 10.0),
         "a body, 10 dB": ("body", 10.0), "a body, 3 dB": ("body", 3.0),
         "an emitter, -70 dB": ("emitter", -70.0), "an emitter, -80 dB": ("emitter", -80.0)}
EFFECTS: dict[str, type[Effect]] = {
    "late": ReceiverClockOffset, "moved": DevicePositionError, "grove": Foliage,
    "body": BodyShadowing, "emitter": Interference}


def hide(world: SimpleNamespace, kind: str, size: float) -> None:
    """Change a campaign, by formulas of this module's own."""
    if kind == "late":
        mine = np.flatnonzero((world.receiver == 1) & (world.slot >= size))
        world.receiver_m[mine] = world.receiver_m[mine - int(size) * len(world.device_m)].copy()
    elif kind == "moved":
        world.device_m[1, 0] += size
    elif kind == "grove":
        azimuth_deg = np.degrees(np.arctan2(world.offset_m[:, 0], world.offset_m[:, 1])) % 360
        level = world.offset_m[:, 2] < 0.5 * np.hypot(*world.offset_m[:, :2].T)
        world.gain_db[(world.device == 2) & level & (azimuth_deg % 180 < 70)] -= size
    elif kind == "body":
        azimuth_deg = np.degrees(np.arctan2(-world.offset_m[:, 0], -world.offset_m[:, 1]))
        behind = np.cos(np.radians(azimuth_deg - world.heading_deg)) < -0.5
        world.gain_db[behind] -= size
    else:
        away_m = np.linalg.norm(world.receiver_m - [250.0, 300.0, 10.0], axis=1)
        noise_db = size - 20 * np.log10(away_m / 100)
        world.gain_db[:] = 10 * np.log10(10**(world.gain_db / 10) + 10**(noise_db / 10))


def compare(seed: int, settings: dict) -> dict:
    """Return both evidences for one case [nats]."""
    # Not at the top: it belongs to no extra.
    from dynesty import NestedSampler

    kind, size = CASES[settings["case"]]
    world = worlds.fly(seed, limit_db=-200.0)  # none is blank
    hide(world, kind, size)
    kept = worlds.measured(world).select(world.slot % EVERY == 0)
    links = prepare_links(kept, None)
    folds = make_folds(links, seed)
    model = cross_validate(links, LogDistanceBase(None, seed), folds, training_parts(links, folds))
    hypotheses = Hypotheses.of(model.whole, seed)
    found = add_effect(model.whole, EFFECTS[kind]())
    if found is None:
        return {"links": len(links), "laplace_nats": None, "nested_nats": None, "sd_nats": None}
    without, with_it = _without(hypotheses), _with(hypotheses, found)
    results = []
    for log_likelihood, low, high in (without, with_it):
        box = np.array([low, high]).T

        def prior(unit: np.ndarray, box: np.ndarray = box) -> np.ndarray:
            return box[:, 0] + unit * (box[:, 1] - box[:, 0])

        sampler = NestedSampler(log_likelihood, prior, len(box), nlive=LIVE_POINTS, sample="rwalk",
                                rstate=np.random.default_rng(seed))
        sampler.run_nested(dlogz=0.2, print_progress=False)
        results.append((sampler.results.logz[-1], sampler.results.logzerr[-1]))
    (base, base_sd), (named, named_sd) = results
    return {"links": len(links), "numbers": len(with_it[1]) - 2,
            "laplace_nats": hypotheses.of_named(found), "nested_nats": float(named - base),
            "sd_nats": float(np.hypot(base_sd, named_sd))}


Sampled = tuple[Callable[[np.ndarray], float], np.ndarray, np.ndarray]


def _without(hypotheses: Hypotheses) -> Sampled:
    nothing = hypotheses.base_z, np.zeros((len(hypotheses.base_z), 0)), np.zeros(0)
    return _of(hypotheses, lambda numbers: nothing, np.zeros(0), np.zeros(0))


def _with(hypotheses: Hypotheses, fit: Fit) -> Sampled:
    """Return the likelihood over the last effect's numbers, within their bounds."""
    own = fit.model.coefficient_slices[-1]
    varied = fit.effects[-1].variation()
    assert varied is not None
    coefficients = fit.coefficients.copy()
    coefficients[own] = 0.0
    coefficients[:len(hypotheses.coefficients)] = hypotheses.coefficients
    plain = FitResult(coefficients, fit.scale_db, np.nan)

    def at(numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        model = fit.model.with_effects([varied.effect(numbers)])
        problem, term = model.training, model.terms[0]
        z = (problem.level_db - problem.predict(plain).mean_db) / hypotheses.scale_db
        return z, term.columns / hypotheses.scale_db[:, None], term.prior_sd_db

    return _of(hypotheses, at, varied.low, varied.high)


def _of(hypotheses: Hypotheses, at: Callable, low: np.ndarray, high: np.ndarray) -> Sampled:
    """Return the marginal likelihood over numbers and the two variances, and their bounds."""
    evidence, links = hypotheses.evidence, hypotheses.links
    rows = evidence.rows
    alike = np.exp(-cdist(links.receiver_m[rows], links.receiver_m[rows]) / evidence.length_m)
    part = np.repeat(np.arange(len(evidence.parts)), [each.stop - each.start
                                                     for each in evidence.parts])
    alike *= part[:, None] == part[None]
    spread = (hypotheses.nuisance.values * hypotheses.nuisance.prior_sd)[rows]
    common = spread @ spread.T

    def log_likelihood(values: np.ndarray) -> float:
        noise, field = np.exp(values[0]), np.exp(values[0] + values[1])
        z, columns, prior_sd = at(values[2:])
        own = (columns * prior_sd)[rows]
        covariance = noise * np.eye(len(rows)) + field * alike + common + own @ own.T
        root = cho_factor(covariance, lower=True)[0]
        white = solve_triangular(root, z[rows], lower=True)
        return float(-0.5 * white @ white - np.log(np.diag(root)).sum()
                     - 0.5 * len(rows) * np.log(2 * np.pi))

    return (log_likelihood, np.concatenate([BOUNDS[0], low]), np.concatenate([BOUNDS[1], high]))


def nested_table(rows: pd.DataFrame) -> str:
    """Return both evidences of each case."""
    lines = [[row["name"], f"{row['links']}", f"{row['laplace_nats']:.1f}",
              f"{row['nested_nats']:.1f} ± {row['sd_nats']:.1f}",
              f"{row['laplace_nats'] - row['nested_nats']:+.1f}"]
             if np.isfinite(row["laplace_nats"] or np.nan) else
             [row["name"], f"{row['links']}", "not proposed", "", ""]
             for _, row in rows.iterrows()]
    return markdown(["hidden", "links", "evidence, Laplace [nats]", "nested sampling [nats]",
                     "difference"], lines)


STUDIES = {"nested": Study("Is the evidence for a cause what it claims to be?", compare,
                           lambda seed: {name: {"case": name} for name in CASES}, nested_table,
                           seeds=1)}
