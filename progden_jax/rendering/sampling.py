"""Samples of a scene, one by one: the k-th of a pixel is the same number whoever asks for it.

Samples come in waves of sizes that depend on the image's size alone: 1, 1, 2, 4, ... up to some
2^20 paths. A wave has a seed of its own, so a series may stop, go on, or be extended without a change.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from progden_jax import _checks
from progden_jax.rendering import _mitsuba
from progden_jax.rendering.moments import AUXILIARY

PATHS = 1 << 20
"""Paths in the largest wave; compiled variants keep some 200 bytes for each."""


class Wave(NamedTuple):
    """The samples `start` to `start` + n of every pixel."""

    start: int
    radiance: Float[np.ndarray, "n h w 3"]
    auxiliary: Float[np.ndarray, "n h w 7"] | None


class Samples:
    """The samples that a sensor of a loaded scene takes, with a box filter: independent pixels.

    Parameters
    ----------
    scene : a loaded ``mitsuba.Scene``; its integrator is used, its film, filter and sampler are not.
    size : height and width in pixels; by default the sensor's film has them.
    seed : any whole number from 0 up.
    sensor : which of the scene's sensors.
    max_depth : take a path tracer of this depth instead of the scene's integrator.
    reference : whether to take other random numbers than a series of the same seed takes.
    auxiliary : whether to find albedo, normal and depth along the way.

    Raises
    ------
    ValueError
        If there is no such sensor, or the integrator cannot give single samples.
    """

    def __init__(
        self,
        scene: Any,
        *,
        size: tuple[int, int] | None = None,
        seed: int = 0,
        sensor: int = 0,
        max_depth: int | None = None,
        reference: bool = False,
        auxiliary: bool = True,
    ) -> None:
        mi = _mitsuba.load()
        sensors = scene.sensors()
        if not 0 <= sensor < len(sensors):
            raise ValueError(f"sensor is {sensor}, but the scene has {len(sensors)}, from 0 up.")
        self._scene, self._integrator = scene, scene.integrator()
        if max_depth is not None:
            _checks.positive_int("max_depth", max_depth)
            self._integrator = mi.load_dict({"type": "path", "max_depth": max_depth})
        if not isinstance(self._integrator, mi.SamplingIntegrator):
            kind = type(self._integrator).__name__
            raise ValueError(
                f"the scene's integrator ({kind}) traces no paths from the camera; pass max_depth "
                "(--max-depth) to render with a path tracer instead."
            )
        self.size = film_size(sensors[sensor]) if size is None else size
        self._aov = mi.load_dict(
            {"type": "aov", "aovs": "albedo:albedo,normal:sh_normal,depth:depth"}
        )
        self._auxiliary = auxiliary
        film = {
            "type": "hdrfilm",
            "height": self.size[0],
            "width": self.size[1],
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
            "component_format": "float32",
        }
        # A batch of one: it brings a film and a sampler of ours to whatever sensor the scene has.
        inner = sensors[sensor]
        opened, open_time = inner.shutter_open(), inner.shutter_open_time()
        self._spec = {"type": "batch", "inner": inner, "film": mi.load_dict(film)}
        self._spec |= {"shutter_open": opened, "shutter_close": opened + open_time}
        if (medium := inner.get_medium()) is not None:
            self._spec["medium"] = medium
        self._sensor = self._sensor_with(seed=0)
        pixels = self.size[0] * self.size[1]
        self._largest = 1 << max(0, (PATHS // pixels).bit_length() - 1)
        # Halves of one range, so that no stream of the reference is one of the series.
        state = int(np.random.SeedSequence(seed).generate_state(1)[0])
        self._first_stream = state + (1 << 31) * reference

    def waves(self, start: int, stop: int) -> Iterator[Wave]:
        """From the wave that holds sample `start`; the last is cut short at `stop`."""
        trace = self._wavefront if _mitsuba.jit() else self._renders
        first, n = 0, 1
        while first < stop:
            if first + n > start:
                yield trace(first, min(n, stop - first))
            first += n
            n = min(first, self._largest)

    def _renders(self, start: int, n: int) -> Wave:
        """By Mitsuba's own renders of one sample each, as the scalar variant has no wavefronts."""
        import mitsuba as mi

        def take(integrator: Any, channels: int) -> np.ndarray:
            images = [
                np.array(mi.render(self._scene, sensor=sensor, integrator=integrator, spp=1))
                for sensor in sensors
            ]
            return np.stack(images)[..., :channels]

        # The seed goes to the sampler, as `render` multiplies its own by the number of pixels: the streams
        # of a pixel are then in a row so regular that means vary up to twice as much as they should.
        sensors = [self._sensor_with(self._stream(k)) for k in range(start, start + n)]
        aux = take(self._aov, AUXILIARY) if self._auxiliary else None
        return Wave(start, take(self._integrator, 3), _clipped(aux))

    def _wavefront(self, start: int, n: int) -> Wave:
        """By one launch in which every lane is a sample: a film would only keep their means.

        Pixels lie side by side and samples behind each other, so that a wave that is cut short holds
        the same first samples as a whole one.
        """
        import drjit as dr
        import mitsuba as mi

        height, width = self.size
        lanes = n * height * width
        sensor = self._sensor  # always the same, or the kernel would be compiled again
        sampler = sensor.sampler()
        sampler.seed(self._stream(start), lanes)
        pixel = dr.arange(mi.UInt32, lanes) % (height * width)
        corner = mi.Point2f(mi.Float(pixel % width), mi.Float(pixel // width))
        position = (corner + sampler.next_2d()) / mi.Point2f(width, height)
        aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
        time = mi.Float(sensor.shutter_open())
        if (open_time := sensor.shutter_open_time()) > 0:
            time += sampler.next_1d() * open_time
        rays, weight = sensor.sample_ray_differential(time, 0.0, position, aperture)
        radiance, _, _ = self._integrator.sample(self._scene, sampler, rays, sensor.get_medium())
        found = [*(weight * radiance)]
        if self._auxiliary:
            found += self._aov.sample(self._scene, sampler, rays)[2]
        dr.eval(found)
        planes = np.stack([np.array(channel).reshape(n, height, width) for channel in found])
        samples = np.moveaxis(planes, 0, -1)
        return Wave(
            start, samples[..., :3], _clipped(samples[..., 3:] if self._auxiliary else None)
        )

    def _sensor_with(self, seed: int) -> Any:
        import mitsuba as mi

        return mi.load_dict(self._spec | {"sampler": {"type": "independent", "seed": seed}})

    def _stream(self, k: int) -> int:
        """The seed of sample k, or of the wave from it on: never twice the same, and without a pattern.

        By the finaliser of MurmurHash3 (Appleby, public domain), a bijection of 32-bit numbers.
        """
        h = (self._first_stream + k) % (1 << 32)
        for shift, factor in ((16, 0x85EBCA6B), (13, 0xC2B2AE35), (16, 1)):
            h = (h ^ h >> shift) * factor % (1 << 32)
        return h


def film_size(sensor: Any) -> tuple[int, int]:
    """Height and width of the whole film, crop windows left aside."""
    width, height = sensor.film().size()
    return int(height), int(width)


def _clipped(auxiliary: np.ndarray | None) -> np.ndarray | None:
    """With albedos in [0, 1]: Mitsuba takes π times the BSDF head-on, which for gloss is above."""
    if auxiliary is not None:
        albedo = auxiliary[..., :3]
        np.clip(albedo, 0, 1, out=albedo)
    return auxiliary
