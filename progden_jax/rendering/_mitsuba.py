"""Mitsuba, imported when first needed, under a variant that works on this machine."""

import logging
from typing import Any

UNUSABLE_LLVM = (15, 16)
"""Major versions that crash while they compile Dr.Jit's kernels."""

PREFERRED, FALLBACK = "llvm_ad_rgb", "scalar_rgb"

_log = logging.getLogger(__name__)


def load(variant: str | None = None) -> Any:
    """The module ``mitsuba``, with its variant set.

    Parameters
    ----------
    variant : one of Mitsuba's names that end in _rgb. By default the one that is set already, else
        llvm_ad_rgb where a usable libLLVM is found, else scalar_rgb, which the log then says.

    Raises
    ------
    ModuleNotFoundError
        If Mitsuba is not installed.
    ValueError
        If there is no such variant, or it cannot run here.
    """
    try:
        import mitsuba as mi
    except ModuleNotFoundError:
        raise ModuleNotFoundError(
            "rendering needs Mitsuba 3, which is not installed: pip install 'progden_jax[render]'"
        ) from None
    current = mi.variant()
    if variant is None and current is not None and current.endswith("_rgb"):
        return mi
    if variant is None:
        variant = PREFERRED
        if problem := _llvm_problem():
            _log.warning(
                "%s: rendering by the slower %s. Debian's libllvm19 works.", problem, FALLBACK
            )
            variant = FALLBACK
    elif problem := _problem(variant, mi.variants()):
        raise ValueError(problem)
    mi.set_variant(variant)
    return mi


def jit() -> bool:
    """Whether the variant that is set traces whole wavefronts in compiled kernels."""
    import mitsuba as mi

    return not (mi.variant() or "").startswith("scalar")


def _problem(variant: str, known: list[str]) -> str:
    usable = [name for name in known if name.endswith("_rgb")]
    if variant not in usable:
        return f"variant is {variant!r}, expected one of {', '.join(usable)}."
    if variant.startswith("llvm") and (problem := _llvm_problem()):
        return f"variant {variant} cannot run: {problem}. Install libllvm19, or take scalar_rgb."
    if variant.startswith("cuda"):
        import drjit as dr

        if not dr.has_backend(dr.JitBackend.CUDA):
            return f"variant {variant} cannot run: there is no NVIDIA GPU with its driver."
    return ""


def _llvm_problem() -> str:
    import drjit as dr

    if not dr.has_backend(dr.JitBackend.LLVM):
        return "no libLLVM was found (DRJIT_LIBLLVM_PATH can name it)"
    version = dr.detail.llvm_version()
    if version[0] in UNUSABLE_LLVM:
        return f"libLLVM {'.'.join(map(str, version))} crashes in compiling kernels"
    return ""
