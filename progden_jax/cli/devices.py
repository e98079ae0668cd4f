"""`progden devices`: where it would compute, and with what."""

import importlib.metadata
import os
import sys
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from progden_jax.cli._run import print_json, tables

HELP = """Show the devices that JAX finds, versions, and the compilation cache.

```
progden devices
JAX_PLATFORMS=cpu progden devices --json
```
"""


def devices(
    *, json: Annotated[bool, Parameter(help="Print it as one JSON object.")] = False
) -> None:
    found = _collect()
    if json:
        print_json(found)
        return
    from rich.table import Table

    from progden_jax.memory import HUGE_PAGES

    table = Table(box=None, show_header=False, padding=(0, 2, 0, 0))
    for d in found["devices"]:
        memory = "" if d["memory"] is None else f", {_size(d['memory'])} of memory"
        used = " (used)" if d["default"] else ""
        table.add_row("device", f"{d['id']}: {d['kind']} ({d['platform']}){memory}{used}")
    for name, version in found["versions"].items():
        table.add_row(name, version or "not installed")
    huge = found["huge_pages"]
    table.add_row(
        "huge pages", "yes" if huge else f"no (GLIBC_TUNABLES={HUGE_PAGES} asks for them)"
    )
    table.add_row("matrix units", found["amx"] or "AMX, for convolutions on the CPU")
    cache = found["cache"]
    table.add_row("compilation cache", f"{cache['folder']} ({_size(cache['bytes'])})")
    tables().print(table, highlight=False, markup=False, soft_wrap=True)


def _collect() -> dict[str, Any]:
    import jax

    from progden_jax import __version__, _amx, memory
    from progden_jax.compilation import cache_folder

    folder = cache_folder()
    default = jax.devices()[0]
    return {
        "devices": [
            {
                "id": str(device),
                "platform": device.platform,
                "kind": device.device_kind,
                "memory": _memory(device),
                "default": device == default,
            }
            for device in jax.devices()
        ],
        "versions": {
            "progden_jax": __version__,
            **{name: _version(name) for name in ("jax", "jaxlib", "pyoidn", "OpenEXR")},
            "python": sys.version.split()[0],
        },
        "huge_pages": memory.huge_pages(),
        "amx": (why := _amx.status()) and f"not used: {why}",
        "cache": {"folder": folder, "bytes": _bytes_below(folder)},
    }


def _memory(device: Any) -> int | None:
    """Bytes of the device's memory, of the machine's for a CPU, None if unknown."""
    stats = device.memory_stats() or {}
    if "bytes_limit" in stats:
        return int(stats["bytes_limit"])
    names = os.sysconf_names if hasattr(os, "sysconf") else {}
    if device.platform == "cpu" and "SC_PHYS_PAGES" in names:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return None


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _bytes_below(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _size(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB"):
        if count < 1024:
            return f"{count:.0f} {unit}" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:.1f} GiB"
