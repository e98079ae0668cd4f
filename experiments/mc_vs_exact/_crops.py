"""Crops that the exact divergence is affordable for."""

import progden_jax as pd


def centre(frame: pd.Frame, size: int) -> pd.Frame:
    """The middle size × size pixels of every buffer."""
    height, width = frame.size
    if size > min(height, width):
        raise ValueError(f"the crop is {size} pixels wide, the frame {width}×{height}.")
    top, left = (height - size) // 2, (width - size) // 2
    changed = {
        name: buffer[top : top + size, left : left + size]
        for name in ("color", "variance", "albedo", "normal", "depth")
        if (buffer := getattr(frame, name)) is not None
    }
    return frame.replace(**changed)
