"""A texture of Mitsuba: stripes of two shades of a colour, along u."""

import drjit as dr
import mitsuba as mi


class Stripes(mi.Texture):
    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.count = props.get("count", 8.0)  # pairs of stripes
        self.colour = mi.Color3f(props.get("colour", mi.ScalarColor3f(0.8, 0.2, 0.1)))
        dr.make_opaque(self.colour)

    def traverse(self, cb: mi.TraversalCallback) -> None:
        cb.put("colour", self.colour, mi.ParamFlags.Differentiable)

    def eval(self, si: mi.SurfaceInteraction3f, active: bool = True) -> mi.Color3f:
        wave = dr.sin(2 * dr.pi * self.count * si.uv.x)
        return (0.75 + 0.25 * dr.sign(wave)) * self.colour

    def eval_1(self, si: mi.SurfaceInteraction3f, active: bool = True) -> mi.Float:
        return mi.luminance(self.eval(si, active))

    def mean(self) -> mi.Float:
        return 0.75 * mi.luminance(self.colour)

    def is_spatially_varying(self) -> bool:
        return True

    def to_string(self) -> str:
        return f"stripes[count={self.count}]"


mi.register_texture("stripes", Stripes)
