"""Make the pictures of README.md and docs/; docs/pictures/README.md lists them.

python docs/pictures/make.py NAME... [--run FOLDER] [--output FOLDER] [--small]
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

from mi_nerfattack import variant

variant.ensure()  # before what imports mitsuba

import country_road  # noqa: E402
import diagrams  # noqa: E402
import flat_objects  # noqa: E402
import gallery_blocks  # noqa: E402
import light_maps  # noqa: E402
import plugin_scenes  # noqa: E402
import run_pictures  # noqa: E402
import worlds  # noqa: E402

# Each function writes its pictures into a folder; small ones are for tests.
PICTURES: dict[str, Callable[[Path, bool], None]] = {
    "loop": diagrams.draw_loop,
    "chart": diagrams.draw_chart,
    "country": country_road.draw_country,
    "flat": flat_objects.draw_flat,
    "gallery": gallery_blocks.gallery,
    "glass": plugin_scenes.glass,
    "light_maps": light_maps.draw_light_maps,
    "plugins": plugin_scenes.plugins,
    "worlds": worlds.draw_worlds,
}
# Each of these shows a finished run, too.
OF_A_RUN: dict[str, Callable[[Path, Path, bool], None]] = {
    "banner": run_pictures.draw_banner,
    "drive": run_pictures.draw_drive,
}


def main() -> None:
    """Make the named pictures."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    names = [*PICTURES, *OF_A_RUN]
    parser.add_argument("names", nargs="+", choices=names, metavar="NAME")
    parser.add_argument("--run", type=Path, help="run folder, for banner and drive")
    parser.add_argument("--output", type=Path, default=Path(__file__).parent)
    parser.add_argument("--small", action="store_true", help="fewer samples and pixels")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for name in options.names:
        if name in PICTURES:
            PICTURES[name](options.output, options.small)
        elif options.run is None:
            sys.exit(f"{name}: give a run folder, for example of make demo, by --run")
        else:
            OF_A_RUN[name](options.run, options.output, options.small)


if __name__ == "__main__":
    main()
