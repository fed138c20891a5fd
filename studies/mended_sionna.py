"""Sionna RT 2.2.0 without two faults in its diffraction that the study `engine` found.

1. Whether a receiver is seen from a diffraction point is tested from a point that is moved off the
   face that the ray had hit, along that face's normal, to the receiver's side. Behind the face that
   is into the wall, where the angle of the wedge's inside exceeds 90 degrees. Such a receiver
   then never gets the ray.
2. The length from a diffraction point to the receiver is summed over the vertices of all depths up
   to `max_depth`, also over those behind the last interaction, which still hold the image of the
   diffraction point. So where reflections follow on the edge and the path has less than `max_depth`
   interactions, the way from the edge to the last reflection counts three times.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from radiotwin.trace.solver import import_sionna


@contextmanager
def mended() -> Iterator[None]:
    """Mend both faults within this context."""
    import_sionna()
    import drjit
    import mitsuba
    from sionna.rt.constants import InteractionType
    from sionna.rt.path_solvers.field_calculator import FieldCalculator
    from sionna.rt.path_solvers.sb_candidate_generator import SBCandidateGenerator as Search

    sample, lengths = Search._sample_radio_material, FieldCalculator._diffraction_compute_s_s_prime

    def sample_outwards(self: Any, si: Any, *others: Any) -> Any:
        """Go on from a diffraction point 1 mm off its edge, as Sionna RT's image method does."""
        found, normal, wedges = sample(self, si, *others)
        diffracted = found.sampled_component == InteractionType.DIFFRACTION
        outward = drjit.normalize(wedges.n0 + wedges.nn)
        si.p = drjit.select(diffracted, si.p + 1e-3 * outward, si.p)
        si.n = drjit.select(diffracted, 0.0, si.n)  # along which rays would start farther off
        return found, normal, wedges

    def lengths_of_path(self: Any, paths: Any, source: Any, target: Any) -> Any:
        """Sum the lengths after and before the diffraction up to the last interaction."""
        after, before = drjit.zeros(mitsuba.Float, paths.buffer_size), drjit.zeros(
            mitsuba.Float, paths.buffer_size)
        bent = drjit.full(mitsuba.Bool, False, paths.buffer_size)
        at = drjit.copy(source)
        for depth in range(1, paths.max_depth + 1):
            kind = paths.get_interaction_type(mitsuba.UInt(depth), True)
            is_used = kind != InteractionType.NONE
            vertex = drjit.select(is_used, paths.get_vertex(mitsuba.UInt(depth), True), at)
            leg = drjit.norm(vertex - at)
            after += drjit.select(bent, leg, 0.0)
            before += drjit.select(bent, 0.0, leg)
            bent |= kind == InteractionType.DIFFRACTION
            at = vertex
        leg = drjit.norm(target - at)
        return (after + drjit.select(bent, leg, 0.0), before + drjit.select(bent, 0.0, leg))

    Search._sample_radio_material = sample_outwards
    FieldCalculator._diffraction_compute_s_s_prime = lengths_of_path
    try:
        yield
    finally:
        Search._sample_radio_material = sample
        FieldCalculator._diffraction_compute_s_s_prime = lengths
