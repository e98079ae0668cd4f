"""OIDN's own library through pyoidn, in float32, on HDR radiance with or without albedo and normal.

On processors with AMX in half precision OIDN would choose that: the variable of its library that holds the
level of instructions is set to AVX-512 beforehand (see tests/native_oidn.py).
"""

import ctypes
import functools
from pathlib import Path
from typing import Any

import numpy as np

_AVX512 = 8  # in ISPC's numbering of targets


@functools.cache
def force_float32() -> None:
    """No half precision, on processors that have AVX-512; others have none to begin with."""
    import pyoidn
    from elftools.elf.elffile import ELFFile

    cpuinfo = Path("/proc/cpuinfo")
    if not cpuinfo.exists() or "avx512vl" not in cpuinfo.read_text():
        return
    folder = Path(pyoidn.__file__).parent / "oidn/lib"
    (path,) = folder.glob("libOpenImageDenoise_device_cpu.so.*")
    ctypes.CDLL(str(path))
    maps = Path("/proc/self/maps").read_text().splitlines()
    base = min(int(line.split("-")[0], 16) for line in maps if line.endswith(str(path)))
    with path.open("rb") as file:
        table: Any = ELFFile(file).get_section_by_name(".symtab")
        found = [s["st_value"] for s in table.iter_symbols() if s.name == "__system_best_isa"]
    for offset in found:
        ctypes.c_int.from_address(base + offset).value = _AVX512


class Filter:
    """OIDN's ray-tracing filter on these images, ready to be executed again and again."""

    def __init__(self, buffers: dict[str, np.ndarray]) -> None:
        import pyoidn

        force_float32()
        self.output = np.zeros_like(buffers["color"])
        self._device: Any = pyoidn.Device()
        self._device.commit()
        self._filter: Any = pyoidn.Filter(self._device, pyoidn.OIDN_FILTER_TYPE_RT)
        names = ("color", "albedo", "normal")
        images = {n: np.ascontiguousarray(buffers[n], np.float32) for n in names if n in buffers}
        self._kept = images | {"output": self.output}
        for name, array in self._kept.items():
            self._filter.set_image(name, array, pyoidn.OIDN_FORMAT_FLOAT3)
        self._filter.set_bool("hdr", True)
        self._filter.set_quality(pyoidn.OIDN_QUALITY_BALANCED)
        self._filter.commit()

    def execute(self) -> np.ndarray:
        """The denoised image, in an array that the next call overwrites."""
        self._filter.execute()
        error = self._device.get_error()
        assert not error, error
        return self.output
