"""Scenes as Mitsuba has them, from its XML files and from dictionaries."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from progden_jax.rendering import _mitsuba

# Nothing is loaded in parallel: emitters would come in an order of chance, and with it other samples.


def load_scene(path: str | os.PathLike[str], parameters: Mapping[str, str] | None = None) -> Any:
    """The ``mitsuba.Scene`` in an XML file.

    Parameters
    ----------
    path : the file; other files that it names are looked for in its folder first.
    parameters : values for the scene's $name placeholders.

    Raises
    ------
    ValueError
        If there is no such file or Mitsuba cannot load it; the message has Mitsuba's.
    """
    mi = _mitsuba.load()
    if not Path(path).is_file():
        raise ValueError(f"{os.fspath(path)}: no such file; expected a Mitsuba scene (.xml).")
    try:
        scene = mi.load_file(os.fspath(path), parallel=False, **(parameters or {}))
    except Exception as error:  # whatever kind its plugins raise
        raise ValueError(f"{os.fspath(path)}: Mitsuba cannot load it: {_text(error)}") from None
    return _checked(scene, os.fspath(path))


def loaded(scene: Any) -> Any:
    """The ``mitsuba.Scene`` of a dictionary, or the scene itself.

    Raises
    ------
    ValueError
        If it is no scene, or Mitsuba cannot load it.
    """
    mi = _mitsuba.load()
    if isinstance(scene, dict):
        try:
            scene = mi.load_dict(scene, parallel=False)
        except Exception as error:
            raise ValueError(f"Mitsuba cannot load the scene: {_text(error)}") from None
    return _checked(scene, "scene")


def _checked(scene: Any, name: str) -> Any:
    import mitsuba as mi

    if not isinstance(scene, mi.Scene):
        kind = type(scene).__name__
        raise ValueError(f"{name} is a {kind}, expected a scene with sensors, shapes and emitters.")
    return scene


def _text(error: Exception) -> str:
    return " ".join(str(error).split())
