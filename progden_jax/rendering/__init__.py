"""Noisy renders with known variance, by Mitsuba 3 (the extra ``render``): procedural scenes or one's own.

`scene` draws a scene from a seed, `load_scene` reads Mitsuba's XML, `series` yields frames as they
grow; `progden render` writes them to files (`progden_jax.rendering.files.render`). Mitsuba is imported by
the first call.
"""

from progden_jax.rendering._mitsuba import load as use_variant
from progden_jax.rendering.loading import load_scene
from progden_jax.rendering.scenes import KINDS, scene
from progden_jax.rendering.series import series

__all__ = ["KINDS", "load_scene", "scene", "series", "use_variant"]
