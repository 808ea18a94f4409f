"""Repaint a hydrant by inverse rendering, in calls of Mitsuba and XML alone."""

from pathlib import Path

import drjit as dr
import mitsuba as mi

import mi_nerfattack  # noqa: F401  registers the plugins

mi.set_variant("llvm_ad_rgb")
scene = mi.load_file(str(Path(__file__).with_name("hydrant.xml")), parallel=False)
params = mi.traverse(scene)
key = "fields.hydrant.colour"

before = mi.render(scene, spp=64)
target = mi.TensorXf(before.numpy()[..., ::-1].copy())  # blue is red, red is blue

optimiser = mi.ad.Adam(lr=0.05, params={key: params[key]})
for step in range(30):
    params.update(optimiser)
    image = mi.render(scene, params, spp=4, seed=step)
    error = dr.mean(dr.square(image - target))
    dr.backward(error)
    optimiser.step()
    optimiser[key] = dr.clip(optimiser[key], 0.01, 0.99)
    if step % 10 == 0:
        print(f"step {step}: rms error {dr.sqrt(error.array)[0]:.4f}")

params.update(optimiser)
after = mi.render(scene, params, spp=64)
error = dr.mean(dr.square(after - target))
print(f"afterwards: rms error {dr.sqrt(error.array)[0]:.4f}")
for name, image in {"before": before, "after": after}.items():
    mi.util.write_bitmap(f"{name}.png", image, write_async=False)
