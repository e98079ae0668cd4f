"""OpenEXR in and out, as renderers write it and compositors expect it.

`read_exr` finds colour, variance, albedo, normal and depth by the conventions of the common
renderers and brings the variance to that of the pixel mean; `describe_exr` says what it would do;
`write_exr` writes a file that is whole or not there. All that goes wrong is an `ExrError`, whose
message names the remedy as a keyword and as the command line's flag.
"""

from progden_jax.exr._file import ExrError
from progden_jax.exr._info import ChannelInfo, ExrInfo, PartInfo, RoleInfo, Values
from progden_jax.exr._map import parse_channel_map
from progden_jax.exr._read import describe_exr, read_exr, read_exr_with_info, read_layers
from progden_jax.exr._render import Settings
from progden_jax.exr._statistics import MEANINGS
from progden_jax.exr._write import COMPRESSIONS, write_exr

__all__ = [
    "COMPRESSIONS",
    "MEANINGS",
    "ChannelInfo",
    "ExrError",
    "ExrInfo",
    "PartInfo",
    "RoleInfo",
    "Settings",
    "Values",
    "describe_exr",
    "parse_channel_map",
    "read_exr",
    "read_exr_with_info",
    "read_layers",
    "write_exr",
]
