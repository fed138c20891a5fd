"""What the ray tracer is asked for.

What the qualities cost and give, measured with `python -m studies tracer` (1000 links in
a dense city, 880 of them detected; two cores; differences from a reference with a million samples):

| quality | links/s | memory  | 9 of 10 links within | RMS    |
|---------|---------|---------|----------------------|--------|
| fast    | 321     | 1.0 GiB | 1.8 dB               | 2.2 dB |
| default | 122     | 1.9 GiB | 0.6 dB               | 1.4 dB |
| high    | 23      | 1.9 GiB | 0.1 dB               | 0.3 dB |

The differences are paths that no ray happened to find, so too few rays make gains too low, never too high. Depth 3
in place of 4 saves a sixth of the time for 1.5 dB; walls let through (`refraction`) move one link in ten by 3.5 dB.
"""

from dataclasses import asdict, dataclass, replace
from typing import Literal

from radiotwin.errors import BadInput

QUALITIES: dict[str, dict[str, int]] = {
    "fast": {"samples_per_src": 30_000},
    "default": {"samples_per_src": 100_000},
    "high": {"samples_per_src": 500_000, "batch_receivers": 20},
}
MAP_SAMPLES = 100  # times the samples of a quality with the solver `map`, where they are shared by all cells

# Entries of the table in which Sionna RT looks up whether a candidate path is new. Two candidates on one entry
# are taken for one, and a path is lost: at Sionna's 10^6 about 8 % of the candidates of 60 receivers, and which
# ones depends on the other receivers in the call. A prime, as the hash is weak in its lower bits.
TABLE_SIZE = 4_000_037
# Share of the rays that turn at an edge of the face they hit. With 0.5 in place of Sionna's 0.2, nine links in ten
# of a dense city lie within 0.5 dB of a reference with ten times the samples, in place of 1.1 dB: what is dark is
# mostly reached over one edge.
DIFFRACTION_PROBABILITY = 0.5


@dataclass(frozen=True)
class SolverSettings:
    """Settings that decide the gains of a trace; all of them go into the map's attributes and its cache key.

    Attributes:
        solver: `paths` finds the paths to each position, `map` averages over lattice cells.
        max_depth: interactions a path, at most.
        samples_per_src: rays launched from each device. What is missed by all of them is missing in the map.
        batch_receivers: positions solved in one call (`paths` only). The call takes about 0.5 GiB and 36 byte *
            `max_depth * samples_per_src * batch_receivers`.
        max_num_paths_per_src: candidate paths that one call can hold (`paths` only).
        diffraction: first-order diffraction at the edges of buildings.
        refraction: paths through walls. Off, as buildings are hollow shells in the usual city model: a ray that
            enters one meets no inner walls, floors or furniture.
        combining: `power` adds the powers of paths (the mean over fading), `coherent` their fields.
        seed: of the interactions that rays take.
    """

    solver: Literal["paths", "map"] = "paths"
    max_depth: int = 4
    samples_per_src: int = 100_000
    batch_receivers: int = 100
    max_num_paths_per_src: int = 1_000_000
    diffraction: bool = True
    refraction: bool = False
    combining: Literal["power", "coherent"] = "power"
    seed: int = 1

    def __post_init__(self):
        for name, allowed in (("solver", ("paths", "map")), ("combining", ("power", "coherent"))):
            if getattr(self, name) not in allowed:
                raise BadInput(f"{name} = {getattr(self, name)!r} is unknown; allowed are {', '.join(allowed)}")
        if self.solver == "map" and self.combining == "coherent":
            raise BadInput("the solver `map` averages powers over cells: combining = 'coherent' needs the solver "
                           "`paths`")
        for name, low, high in (("max_depth", 0, 20), ("samples_per_src", 1, 10**9), ("batch_receivers", 1, 10**5),
                                ("max_num_paths_per_src", 1, 10**8), ("seed", 0, 2**31 - 1)):
            if not low <= getattr(self, name) <= high:
                raise BadInput(f"{name} = {getattr(self, name)}: allowed is {low} to {high}")

    @classmethod
    def of_quality(cls, quality: str = "default", **others) -> "SolverSettings":
        """Settings by the name of a quality.

        Args:
            quality: `fast`, `default` or `high`.
            others: fields that differ from it.

        Raises:
            BadInput: no such quality.
        """
        if quality not in QUALITIES:
            raise BadInput(f"quality {quality!r} is unknown; allowed are {', '.join(QUALITIES)}")
        settings = dict(QUALITIES[quality])
        if others.get("solver") == "map":
            settings["samples_per_src"] *= MAP_SAMPLES
        return cls(**(settings | others))

    def finer(self, factor: int) -> "SolverSettings":
        """The same with `factor` times the rays, in the same memory."""
        return replace(self, samples_per_src=factor * self.samples_per_src,
                       batch_receivers=max(1, self.batch_receivers // factor))

    def attributes(self) -> dict:
        """All that decides a gain, as attributes of a NetCDF file (which has no booleans)."""
        own = {name: int(value) if isinstance(value, bool) else value for name, value in asdict(self).items()}
        return own | {"table_size": TABLE_SIZE, "diffraction_probability": DIFFRACTION_PROBABILITY}
