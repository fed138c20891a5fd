"""Loss in proportion to distance: gas, rain, or vegetation everywhere.

Specific attenuation γ [dB/km] times path length [km] (ITU-R P.676-13, P.838-3, P.833-10).
"""

from radiotwin.effects.base import Effect, Parameter, Term, View

SPREAD_DB_KM = 30.0


class ExcessAttenuation(Effect):
    """A specific attenuation that the channel's exponent does not stand for."""

    name = "excess_attenuation"
    confused_with = ("foliage", "receiver_saturation")

    def propose(self, view: View) -> list[dict]:
        return [{}]

    def term(self, records, setting, at) -> Term:
        return Term.of_columns(-records.distance_m[:, None] / 1000, SPREAD_DB_KM, ["specific_attenuation"])

    def unphysical(self, setting, coefficients) -> str | None:
        if coefficients[0] < 0:
            return f"it would have to amplify, by {-coefficients[0]:.1f} dB/km"
        return None

    def parameters(self, records, setting, found) -> dict[str, Parameter]:
        return {"specific_attenuation_db_km": Parameter.normal(found.coefficients[0], found.deviations[0], "dB/km")}
