"""Settings of the ray tracer.

Cost and accuracy of the qualities (docs/results/tracer.md: 1000 links in a dense city, 880 of them
detected; two cores; differences from a reference with a million samples):

| quality | links/s | memory  | 9 of 10 links within | RMS    |
|---------|---------|---------|----------------------|--------|
| fast    | 321     | 1.0 GiB | 1.8 dB               | 2.2 dB |
| default | 122     | 1.9 GiB | 0.6 dB               | 1.4 dB |
| high    | 23      | 1.9 GiB | 0.1 dB               | 0.3 dB |

The differences are paths that no ray happened to find, so too few rays make gains too low, never
too high. Depth 3 instead of 4 saves a sixth of the time at a cost of 1.5 dB; paths through walls
(`refraction`) change one link in ten by 3.5 dB.
"""

import math
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from radiotwin.errors import BadInput
from radiotwin.trace import mended

QUALITIES: dict[str, dict[str, int]] = {
    "fast": {"samples_per_src": 30_000},
    "default": {"samples_per_src": 100_000},
    "high": {"samples_per_src": 500_000, "batch_receivers": 20},
}

FINER = 10  # factor of rays, for the estimate of the numerical noise
MEMORY_MARGIN = 1.5  # factor for memory that earlier calls have not freed
# Entries of the hash table by which Sionna RT finds out whether a candidate path is new. Candidates
# that share an entry are taken for one, and a path is dropped: with Sionna's 10^6 entries, about
# 8 % of the candidates of 60 receivers, depending on the other receivers of the call. A prime, as
# the hash is weak in its lower bits.
TABLE_SIZE = 4_000_037
# Share of the rays that are diffracted at an edge of the face they hit. With 0.5 instead of
# Sionna's 0.2, nine in ten links of a dense city are within 0.5 dB of a reference with ten times
# the samples, instead of 1.1 dB: shadowed points are mostly reached over one edge.
DIFFRACTION_PROBABILITY = 0.5


@dataclass(frozen=True)
class SolverSettings:
    """Settings that the gains of a trace depend on; they are in the map's attributes and cache key.

    Attributes:
        solver: `paths` finds the paths to each position, `map` averages over lattice cells.
        max_depth: Maximum number of interactions of a path.
        samples_per_src: Rays launched from each device. A path that no ray finds is missing.
        batch_receivers: Positions solved in one call (`paths` only). The call needs about 0.5 GiB
            and 36 bytes * `max_depth * samples_per_src * batch_receivers`.
        max_num_paths_per_src: Candidate paths that one call can hold (`paths` only).
        diffraction: First-order diffraction at the edges of buildings: `reciprocal`, the same in
            both directions and exact for conductors (`radiotwin.trace.mended`, the default if the
            installed version of Sionna RT can be patched); `sionna`, as released; `off`.
        refraction: Paths through walls. Off, as buildings are hollow shells in the usual city
            model: a ray that enters one meets no inner walls, floors or furniture.
        combining: `power` adds the powers of paths (the mean over fading), `coherent` their fields.
        seed: Seed of the random interactions of rays.
        radius_m: Culling radius [m]: geometry farther from the lines of a batch's links is left out
            (`paths` only, see `radiotwin.trace.link_job`); infinite: none is. None: 400 m in a city
            of more than 5,000 shapes, else infinite.
        compute_device: `cpu`, or `cuda`: a GPU, whose gains differ from the processor's.
    """

    solver: Literal["paths", "map"] = "paths"
    max_depth: int = 4
    samples_per_src: int = 100_000
    batch_receivers: int = 100
    max_num_paths_per_src: int = 1_000_000
    diffraction: Literal["reciprocal", "sionna", "off"] = field(
        default_factory=mended.default_diffraction)
    refraction: bool = False
    combining: Literal["power", "coherent"] = "power"
    seed: int = 1
    radius_m: float | None = None
    compute_device: Literal["cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        for name, allowed in (("solver", ("paths", "map")), ("combining", ("power", "coherent")),
                              ("diffraction", ("reciprocal", "sionna", "off")),
                              ("compute_device", ("cpu", "cuda"))):
            if getattr(self, name) not in allowed:
                raise BadInput(f"{name} = {getattr(self, name)!r} is unknown; allowed are "
                               f"{', '.join(allowed)}")
        installed = mended.installed_version()
        if self.diffraction == "reciprocal" and installed != mended.KNOWN_VERSION:
            raise BadInput(f"diffraction = 'reciprocal' mends Sionna RT {mended.KNOWN_VERSION}, "
                           f"and {installed} is installed; take diffraction = 'sionna', or pip "
                           f"install sionna-rt=={mended.KNOWN_VERSION}")
        if self.solver == "map" and self.combining == "coherent":
            raise BadInput("the solver `map` averages powers over cells: combining = 'coherent' "
                           "needs the solver `paths`")
        for name, low, high in (("max_depth", 0, 20), ("samples_per_src", 1, 10**9),
                                ("batch_receivers", 1, 10**5), ("max_num_paths_per_src", 1, 10**8),
                                ("seed", 0, 2**31 - 1)):
            if not low <= getattr(self, name) <= high:
                raise BadInput(f"{name} = {getattr(self, name)}: allowed is {low} to {high}")
        if self.radius_m is not None and not self.radius_m > 0:
            raise BadInput(f"radius_m = {self.radius_m:g}: allowed is a length above 0 m, or inf "
                           "for the whole city")
        if self.solver == "map" and self.is_tiled:
            raise BadInput(f"radius_m = {self.radius_m:g}: the solver `map` follows all rays "
                           "through the whole city; a culling radius needs the solver `paths`")

    @property
    def is_tiled(self) -> bool:
        """Whether batches are solved in tiles, i.e. with a finite culling radius."""
        return self.radius_m is not None and math.isfinite(self.radius_m)

    @classmethod
    def of_quality(cls, quality: str = "default", **others: Any) -> "SolverSettings":
        """Return the settings of one of QUALITIES; the solver `map` gets 100 times its rays.

        `others` are fields that differ from it. BadInput if there is no such quality.
        """
        if quality not in QUALITIES:
            raise BadInput(f"quality {quality!r} is unknown; allowed are {', '.join(QUALITIES)}")
        settings = dict(QUALITIES[quality])
        if others.get("solver") == "map":
            settings["samples_per_src"] *= 100  # all cells share the rays
        return cls(**(settings | others))

    def finer(self, factor: int) -> "SolverSettings":
        """Return settings with `factor` times the rays, for that many times fewer receivers."""
        return replace(self, samples_per_src=factor * self.samples_per_src,
                       batch_receivers=max(1, self.batch_receivers // factor))

    def memory_bytes(self) -> int:
        """Return the most memory [bytes] that solving a batch takes; 0: not known (`map`)."""
        if self.solver == "map":
            return 0
        rays = self.max_depth * self.samples_per_src * self.batch_receivers
        return int(MEMORY_MARGIN * (2**29 + 36 * rays))

    def attributes(self) -> dict[str, Any]:
        """Return everything that a gain depends on, as attributes of a NetCDF file.

        `compute_device` is left out for processors: their maps are the same on every machine; so is
        `radius_m` if the whole city is traced.
        `wedge` (the model of edges) is only there for `reciprocal`: a map with `diffraction` 1 and
        no `wedge` has Sionna RT's own. NetCDF has no booleans: they are 0 and 1.
        """
        found = {name: int(value) if isinstance(value, bool) else value
                 for name, value in asdict(self).items()
                 if name != "radius_m" or self.is_tiled}
        found["diffraction"] = int(self.diffraction != "off")
        if self.diffraction == "reciprocal":
            found["wedge"] = self.diffraction
        if self.compute_device == "cpu":
            del found["compute_device"]
        return found | {
            "table_size": TABLE_SIZE, "diffraction_probability": DIFFRACTION_PROBABILITY,
            "paths_counted": "once", "ground": "half space"}
