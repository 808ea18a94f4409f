"""Pictures of the gallery: its own blocks make them."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path

from images import write_jpeg
from PIL import Image

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "docs"))
import follow  # noqa: E402  lies in the folder above


def gallery(folder: Path, small: bool) -> None:
    """Run the blocks of docs/gallery.md and convert the images that they write.

    Args:
        folder: where the pictures go.
        small: render four samples per pixel.
    """
    text = (ROOT / "docs/gallery.md").read_text("utf-8")
    if small:
        text = re.sub(r"spp([ =])\d+", r"spp\g<1>4", text)
    with tempfile.TemporaryDirectory() as scratch:
        checkout = Path(scratch)
        for name in ("docs", "scenes"):
            (checkout / name).symlink_to(ROOT / name)
        page = checkout / "gallery.md"
        page.write_text(text, "utf-8")
        for line in follow.follow(page, checkout, long=False):
            print(line, flush=True)
        for path in sorted(checkout.glob("*.png")):
            write_jpeg(folder / f"{path.stem}.jpg", Image.open(path))
