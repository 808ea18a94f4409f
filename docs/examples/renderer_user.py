"""Fit a field to pictures of a mesh, and render it from elsewhere beside that mesh."""

from pathlib import Path

import mitsuba as mi

from mi_nerfattack import capture, fit, scenes
from mi_nerfattack.render.lighting.lights import Lighting

mi.set_variant("llvm_ad_rgb")

mesh = capture.Placement(height_m=0.75).mesh(scenes.bundled("hydrant/hydrant.glb"))
views = capture.render_views(
    mesh, n_views=32, size_px=96, seed=0, lighting=Lighting(), progress=print
)
options = fit.FitOptions(steps=250, batch_rays=4096, occupancy_resolution=32)
result = fit.fit_object(views, 32, options)
print(f"{result.psnr_heldout_db:.1f} dB on {len(result.per_view)} held-out views")
result.save(Path("hydrant.safetensors"), {"source": "hydrant.glb"})

camera = mi.ScalarTransform4f().look_at([1.6, -1.2, 0.7], [0, 0, 0.36], [0, 0, 1])
scene = mi.load_dict(
    {
        "type": "scene",
        "integrator": {
            "type": "field_integrator",
            "object": {"type": "grid_field", "filename": "hydrant.safetensors"},
            "behind": {"type": "path"},
        },
        "ground": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)},
        "light": {"type": "constant"},
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": camera,
            "film": {"type": "hdrfilm", "width": 240, "height": 180},
        },
    },
    parallel=False,
)
image = mi.render(scene, spp=8)
mi.util.write_bitmap("hydrant.png", image, write_async=False)
print("hydrant.safetensors, hydrant.png")
