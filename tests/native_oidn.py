"""The native Open Image Denoise, made to compute in float32 so that parity can be tested to float32.

On processors with AMX-FP16 its CPU device convolves in half precision (1e-3 off), and no parameter turns that
off. The level of instructions it found is kept in variables of its library, unset (-1) until first asked
for: setting them to SSE4 beforehand is what a processor without AMX would give.
"""

import ctypes
import functools
from pathlib import Path

import numpy as np
import pyoidn
from elftools.elf.elffile import ELFFile

_SSE4 = 3  # In ISPC's numbering of targets.


@functools.cache
def _force_float32() -> None:
    (path,) = (Path(pyoidn.__file__).parent / "oidn/lib").glob(
        "libOpenImageDenoise_device_cpu.so.*"
    )
    ctypes.CDLL(str(path))
    maps = Path("/proc/self/maps").read_text().splitlines()
    base = min(int(line.split("-")[0], 16) for line in maps if line.endswith(str(path)))
    with path.open("rb") as file:
        table = ELFFile(file).get_section_by_name(".symtab")
        found = [s["st_value"] for s in table.iter_symbols() if s.name == "__system_best_isa"]
    assert found, "this build of OIDN keeps its instruction level elsewhere"
    for offset in found:
        ctypes.c_int.from_address(base + offset).value = _SSE4


def denoise(
    color: np.ndarray, *auxiliary: np.ndarray, quality: str = "balanced", clean_aux: bool = False
) -> np.ndarray:
    """What OIDN's own library makes of an HDR image, in float32."""
    _force_float32()
    images = [np.ascontiguousarray(a, np.float32) for a in (color, *auxiliary)]
    return pyoidn.denoise(*images, hdr=True, quality=quality, clean_aux=clean_aux)


def _set_weights(chain: pyoidn.Filter, weights: bytes) -> None:
    """OIDN takes user weights as filter data, a call that pyoidn leaves out."""
    from pyoidn.capi import oidn_ffi

    library = Path(pyoidn.__file__).parent / "oidn/lib/libOpenImageDenoise.so.2"
    call = ctypes.CDLL(str(library)).oidnSetSharedFilterData
    call.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_char_p, ctypes.c_size_t]
    call(int(oidn_ffi.cast("uintptr_t", chain._filter)), b"weights", weights, len(weights))


def run_filter(
    output_like: np.ndarray,
    *,
    quality: int = pyoidn.OIDN_QUALITY_BALANCED,
    weights: bytes | None = None,
    **images: np.ndarray,
) -> np.ndarray:
    """OIDN's ray-tracing filter on any set of images, with weights of one's own if given."""
    _force_float32()
    output = np.zeros_like(output_like)
    arrays = {name: np.ascontiguousarray(a, np.float32) for name, a in images.items()}
    with pyoidn.Device() as device:
        device.commit()
        with pyoidn.Filter(device, pyoidn.OIDN_FILTER_TYPE_RT) as chain:
            for name, array in (*arrays.items(), ("output", output)):
                chain.set_image(name, array, pyoidn.OIDN_FORMAT_FLOAT3)
            if "color" in images:
                chain.set_bool("hdr", True)
            chain.set_quality(quality)
            if weights is not None:
                _set_weights(chain, weights)
            chain.commit()
            chain.execute()
        error = device.get_error()
    assert not error, error
    return output
