"""The flags that `denoise` takes, in groups, with the checks that need no file.

Strings become the library's objects here and nowhere else.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from progden_jax.cli._run import UsageError

if TYPE_CHECKING:
    from progden_jax.combiner import DeepCombiner
    from progden_jax.denoisers import NFOR, Network
    from progden_jax.divergence import Method
    from progden_jax.exr import Settings
    from progden_jax.frame import Frame
    from progden_jax.skipping import Skip

Quality = Literal["fast", "balanced", "high"]
VarianceOf = Literal["mean", "samples", "std", "second-moment"]


@dataclass(frozen=True)
class MethodChoice:
    """A divergence estimator as `--method` names it: the class in progden_jax, and fixed settings."""

    type: str
    settings: dict[str, Any] = field(default_factory=dict)
    takes_probes: bool = True


METHODS = {
    "monte-carlo": MethodChoice("MonteCarlo"),
    "monte-carlo-gaussian": MethodChoice("MonteCarlo", {"distribution": "gaussian"}),
    "finite-difference": MethodChoice("FiniteDifference"),
    "probing": MethodChoice("Probing"),
    **{
        f"cone-{levels}": MethodChoice("TruncatedCone", {"levels": levels}, takes_probes=False)
        for levels in (1, 2, 3)
    },
    "exact": MethodChoice("Exact", takes_probes=False),
}

SAVE = ("alpha", "sure", "denoised", "divergence", "noisy", "variance", "albedo", "normal")
"""What `--save` takes; it needs a variance but for the items in `SAVE_ALWAYS`."""

SAVE_ALWAYS = ("denoised", "noisy", "albedo", "normal")


@Parameter(name="*", group="Reading the render")
@dataclass(frozen=True)
class ReadOptions:
    """How the channels of the input are to be understood."""

    spp: Annotated[
        float | None,
        Parameter(help="Samples per pixel, where neither the file nor its name tells."),
    ] = None
    variance_of: Annotated[
        VarianceOf | None,
        Parameter(
            help="What the variance channels hold: the variance of the pixel mean (default) or of its "
            "samples (pbrt), the standard deviation of the mean, or second moments (Mitsuba)."
        ),
    ] = None
    variance_from: Annotated[
        tuple[Path, ...] | None,
        Parameter(
            consume_multiple=True,
            help="Two half buffers, or renders of other seeds, to take the variance from; for several "
            "inputs, folders that hold files of the same names.",
        ),
    ] = None
    channels: Annotated[
        str | None,
        Parameter(
            help="What is what, where names do not tell: role=LAYER for color, variance, albedo, normal and "
            'depth, with commas; role=none leaves one out. "color=Beauty,albedo=DiffCol,normal=none"'
        ),
    ] = None
    part: Annotated[
        str | None, Parameter(help="Part of a multi-part file to take the colour from.")
    ] = None

    def check(self) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        from progden_jax.exr import ExrError, parse_channel_map

        if self.spp is not None and not 0 < self.spp < float("inf"):
            raise UsageError(f"--spp is {self.spp:g}, expected a number above 0.")
        if self.variance_from == ():
            raise UsageError("--variance-from needs at least one file.")
        if self.variance_from and self.variance_of:
            raise UsageError(
                "--variance-of says how to read variance channels, --variance-from takes other renders "
                "instead: give one of them."
            )
        if self.channels is not None:
            try:
                parse_channel_map(self.channels)
            except ExrError as error:
                raise UsageError(str(error)) from None

    def settings(
        self, variance_from: Sequence[Path] | None = None, *, auxiliary: bool = True
    ) -> "Settings":
        """The keyword arguments of `read_exr`."""
        others = self.variance_from if variance_from is None else variance_from
        return {
            "spp": self.spp,
            "variance_of": self.variance_of,
            "variance_from": tuple(others or ()),
            "channels": self.channels,
            "part": self.part,
            "auxiliary": auxiliary,
        }


@Parameter(name="*", group="Denoiser")
@dataclass(frozen=True)
class NetworkOptions:
    """Which network denoises, and on what."""

    denoiser: Annotated[
        str | None,
        Parameter(
            help="A network by name, such as oidn-hdr-alb, or a file of weights (.tza, .safetensors), or "
            "nfor, regression without a network; by default OIDN's for the buffers in the file."
        ),
    ] = None
    combiner: Annotated[
        str | None,
        Parameter(
            help="Weights of a deep combiner, which combines the denoised image with the render: the name of "
            "a denoiser that some are shipped for, or a .safetensors file. Those for sub-averages of the "
            "samples take --halves."
        ),
    ] = None
    quality: Annotated[
        Quality | None,
        Parameter(
            help="OIDN's small, base or large weights, where it has them [default: balanced]."
        ),
    ] = None
    weights: Annotated[
        Path | None, Parameter(help="Weights of your own for OIDN's network, a .tza file.")
    ] = None
    no_aux: Annotated[bool, Parameter(help="Leave albedo and normal out.")] = False
    clean_aux: Annotated[
        bool, Parameter(help="Albedo and normal are free of noise: take the weights for that.")
    ] = False
    prefilter: Annotated[
        bool,
        Parameter(help="Denoise albedo and normal first, then take the weights for clean ones."),
    ] = False
    exposure: Annotated[
        str,
        Parameter(help="What radiance is multiplied by for the network, or auto [default: auto]."),
    ] = "auto"

    def check(self) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        from progden_jax import combiner, denoisers

        if self.combiner is not None:
            try:
                combiner.read(self.combiner)
            except ValueError as error:
                raise UsageError(f"--combiner: {error}") from None
        named = "--denoiser" if self.denoiser else "--weights" if self.weights else None
        if self.denoiser and self.weights:
            raise UsageError("--denoiser and --weights both name a network: give one of them.")
        if named and self.quality:
            raise UsageError(f"{named} names a network, so there is no --quality to choose.")
        if self.clean_aux and self.prefilter:
            raise UsageError(
                "--clean-aux says that albedo and normal are free of noise, --prefilter denoises them: "
                "give one of them."
            )
        aux_flag = "--clean-aux" if self.clean_aux else "--prefilter" if self.prefilter else None
        if self.no_aux and aux_flag:
            raise UsageError(f"--no-aux leaves out the albedo and normal that {aux_flag} is about.")
        name = self.denoiser
        file = bool(name and name.endswith((".tza", ".safetensors")))
        if name and not file and name not in denoisers.names():
            raise UsageError(
                f"--denoiser is {name!r}, expected one of {', '.join(denoisers.names())}, or a file that "
                "ends in .tza or .safetensors."
            )
        if name and not file and self.no_aux and "-alb" in name.replace("calb", "alb"):
            raise UsageError(f"--no-aux leaves out the albedo that {name} takes.")
        if name and aux_flag and not name.startswith("oidn-hdr-calb") and not file:
            raise UsageError(
                f"{aux_flag} is for networks that take clean albedo and normal (oidn-hdr-calb-cnrm), "
                f"and --denoiser names {name}."
            )
        if self.weights and self.weights.suffix != ".tza":
            raise UsageError(f"--weights is {self.weights}, expected a file that ends in .tza.")
        exposed = not name or name.endswith(".tza") or name in denoisers.oidn.NAMES
        if self.exposure_value() is not None and not exposed:
            raise UsageError(f"--exposure is for OIDN's networks, and --denoiser names {name}.")

    @property
    def sub_averages(self) -> int:
        """How many of a render the combiner takes; 1 without one."""
        from progden_jax import combiner

        return 1 if self.combiner is None else combiner.read(self.combiner).network.buffers

    def exposure_value(self) -> float | None:
        """The exposure as the library takes it."""
        if self.exposure == "auto":
            return None
        try:
            value = float(self.exposure)
        except ValueError:
            value = 0.0
        if not 0 < value < float("inf"):
            raise UsageError(f"--exposure is {self.exposure!r}, expected auto or a number above 0.")
        return value

    def load(self, frame: "Frame") -> "tuple[Frame, Network | NFOR | DeepCombiner]":
        """The frame as the network is to see it (prefiltered if asked for), and the denoiser."""
        from progden_jax import combiner

        frame, denoiser = self._load_network(frame)
        if self.combiner is None:
            return frame, denoiser
        return frame, combiner.load(self.combiner, denoiser)

    def _load_network(self, frame: "Frame") -> "tuple[Frame, Network | NFOR]":
        from progden_jax import denoisers

        quality, exposure = self.quality or "balanced", self.exposure_value()
        if self.prefilter:
            frame = denoisers.prefilter(frame, quality=quality)
        named = self.denoiser or self.weights
        if named:
            return frame, denoisers.load(named, exposure=exposure)
        clean = self.clean_aux or self.prefilter
        return frame, denoisers.for_frame(
            frame, quality=quality, clean_aux=clean, exposure=exposure
        )


@Parameter(name="*", group="Error estimate")
@dataclass(frozen=True)
class EstimateOptions:
    """How the divergence behind SURE is estimated."""

    method: Annotated[
        str | None,
        Parameter(
            help=f"Of the divergence: {', '.join(METHODS)} [default: {next(iter(METHODS))}]."
        ),
    ] = None
    probes: Annotated[
        int | None, Parameter(help="Random probes: more cost time and smooth the SURE map.")
    ] = None
    seed: Annotated[int, Parameter(help="Of the random probes [default: 0].")] = 0
    mixer: Annotated[
        str | None,
        Parameter(
            help="What gives the share of the denoised image: the name of a denoiser that a network is "
            "shipped for, any, closed-form, or a .safetensors file [default: the denoiser's, else any]."
        ),
    ] = None

    def check(self) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        if self.method is not None and self.method not in METHODS:
            raise UsageError(f"--method is {self.method!r}, expected one of {', '.join(METHODS)}.")
        if self.probes is not None and self.probes < 1:
            raise UsageError(f"--probes is {self.probes}, expected at least 1.")
        if self.probes and self.method and not METHODS[self.method].takes_probes:
            raise UsageError(f"--method {self.method} takes no --probes.")
        if not 0 <= self.seed < 2**32:
            raise UsageError(f"--seed is {self.seed}, expected 0 to {2**32 - 1}.")
        if self.mixer is not None:
            from progden_jax import mixers

            try:
                mixers.load(self.mixer)
            except ValueError as error:
                raise UsageError(f"--mixer: {error}") from None

    @property
    def exact(self) -> bool:
        """Whether the divergence is to be exact, which may take an hour."""
        return self.method is not None and METHODS[self.method].type == "Exact"

    def build(self) -> "Method":
        """The estimator."""
        import progden_jax as pd
        from progden_jax.pipeline import DEFAULT_METHOD

        if self.method is None and self.probes is None:
            return DEFAULT_METHOD
        choice = METHODS[self.method or next(iter(METHODS))]
        settings = dict(choice.settings)
        if self.probes is not None:
            settings["probes"] = self.probes
        try:
            return getattr(pd, choice.type)(**settings)
        except ValueError as error:
            raise UsageError(f"--method {self.method}: {error}") from error


@Parameter(name="*", group="Run time and memory")
@dataclass(frozen=True)
class CostOptions:
    """What a run may take, and what it may leave out."""

    max_memory: Annotated[
        str | None,
        Parameter(
            help="Upper bound, such as 4GiB: images that need more are computed in parts, with the same "
            "result."
        ),
    ] = None
    no_skip: Annotated[
        bool,
        Parameter(help="Compute tiles, too, whose noise is nothing already."),
    ] = False
    converged: Annotated[
        float | None,
        Parameter(
            help="What counts as nothing: a standard error of at most this share of the radiance "
            "[default: 1e-6, which changes no result]."
        ),
    ] = None

    def check(self) -> None:
        """Raise UsageError for what is wrong whatever the files hold."""
        if self.max_memory is not None:
            self.max_bytes()
        if self.converged is not None and self.no_skip:
            raise UsageError("--converged says what to skip, and --no-skip forbids it.")
        self.rule()

    def max_bytes(self) -> int | None:
        """The bound in bytes."""
        from progden_jax.memory import parse_size

        try:
            return None if self.max_memory is None else parse_size(self.max_memory)
        except ValueError as error:
            raise UsageError(f"--max-memory: {error}") from None

    def rule(self) -> "Skip | bool":
        """What `progressive_denoise` takes as skip."""
        from progden_jax.skipping import Skip

        if self.converged is None:
            return not self.no_skip
        try:
            return Skip(self.converged)
        except ValueError as error:
            raise UsageError(f"--converged: {error}") from None


def parse_save(text: str | None) -> tuple[str, ...]:
    """The items of `--save`, each once."""
    items = tuple(dict.fromkeys(s.strip() for s in (text or "").split(",") if s.strip()))
    if text is not None and not items:
        raise UsageError(f"--save needs names with commas, of {', '.join(SAVE)}.")
    for item in items:
        if item not in SAVE:
            raise UsageError(f"--save: {item!r} is unknown, expected some of {', '.join(SAVE)}.")
    return items
