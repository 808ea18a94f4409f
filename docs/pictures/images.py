"""Write pictures as small files."""

from __future__ import annotations

from pathlib import Path

from PIL import Image


def write_jpeg(path: Path, image: Image.Image, max_width_px: int = 1000) -> None:
    """Write an image as JPEG, scaled down if it is wider than `max_width_px`."""
    image = image.convert("RGB")
    image.thumbnail((max_width_px, image.height), Image.Resampling.LANCZOS)
    image.save(path, quality=80, optimize=True, progressive=True)
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB", flush=True)
