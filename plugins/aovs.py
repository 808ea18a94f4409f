"""Opacity, depth and layers of fields, as channels of an image."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from mi_nerfattack.render.composite import Seen


@dataclass(frozen=True)
class FieldChannels:
    """The channels that an image of fields has after its colour.

    Attributes:
        ids: of the fields; none for no channels.
    """

    ids: tuple[str, ...]

    def names(self) -> list[str]:
        """Name the channels of an image."""
        layers = [f"{name}.{c}" for name in self.ids for c in "RGBAZ"]
        return ["opacity", "depth", *layers] if self.ids else []

    def film_names(self) -> list[str]:
        """Name those of the film, which averages: depths times opacities."""
        moments = {depth: moment for depth, _, moment in self._depths()}
        return [moments.get(name, name) for name in self.names()]

    def of_film(self, seen: Seen) -> list[mi.Float]:
        """Return the film's channels of rays, (n,) each."""
        return self._list(seen, [m.moment for m in (seen.total, *seen.layers)])

    def of_sample(self, seen: Seen) -> list[mi.Float]:
        """Return the image's channels of rays, (n,) each; depth 0 of nothing."""
        marches = seen.total, *seen.layers
        depths = [dr.select(m.opacity > 0, m.depth, 0) for m in marches]
        return self._list(seen, depths)

    def develop(self, image: mi.TensorXf, after: int) -> mi.TensorXf:
        """Divide moments by opacities; infinite where there is nothing.

        Args:
            image: of the film; differentiable.
            after: number of channels that come after the fields'.
        """
        names = self.names()
        height, width, count = image.shape
        first = count - after - len(names)
        index = dr.arange(mi.UInt32, height * width * count)
        channel = index % count
        values = mi.Float(image.array)
        for depth, opacity, _ in self._depths():
            here = channel == first + names.index(depth)
            back = names.index(depth) - names.index(opacity)
            weight = dr.gather(mi.Float, image.array, index - mi.Int32(back), here)
            mean = values / dr.select(weight > 0, weight, 1)
            values = dr.select(here, dr.select(weight > 0, mean, dr.inf), values)
        return mi.TensorXf(values, image.shape)

    def _depths(self) -> list[tuple[str, str, str]]:
        """Name each depth, its opacity, and its moment."""
        layers = [(f"{name}.Z", f"{name}.A", f"{name}.moment") for name in self.ids]
        return [("depth", "opacity", "moment"), *layers] if self.ids else []

    def _list(self, seen: Seen, depths: list[mi.Float]) -> list[mi.Float]:
        if not self.ids:
            return []
        found = [seen.total.opacity, depths[0]]
        for layer, depth in zip(seen.layers, depths[1:], strict=True):
            found += [*layer.radiance, layer.opacity, depth]
        return found
