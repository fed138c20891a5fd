"""Effects that a channel model may lack: base classes by stage, parameters, catalogue, registry."""

from radiotwin.effects.base import (
    DetectionEffect,
    Effect,
    GainEffect,
    LimitEffect,
    PathEffect,
    ReceiverEffect,
    Term,
)
from radiotwin.effects.params import EffectParams, Estimate, Parameter, Variation, quantity
from radiotwin.effects.registry import catalogue, effect_named, register

__all__ = ["DetectionEffect", "Effect", "EffectParams", "Estimate", "GainEffect", "LimitEffect",
           "Parameter", "PathEffect", "ReceiverEffect", "Term", "Variation", "catalogue",
           "effect_named", "quantity", "register"]
