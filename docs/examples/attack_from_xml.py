"""Attack two hydrants of a Mitsuba scene, then drive past them path-traced."""

import sys
from dataclasses import replace
from pathlib import Path

import mi_nerfattack as nf  # before drjit, since it chooses the LLVM

# isort: split
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
horizon, iterations = map(int, sys.argv[1:] or (40, 12))
folder, place = Path(__file__).parent, nf.bundled_place()
route = nf.Route.from_file(place.routes, "right")
driver = nf.TorchPolicy(nf.PilotNet.load(nf.bundled("policy/pilotnet.safetensors")))
keys, start = ["fields.near.colour", "fields.far.colour"], route.pose_at(6.0)

scene = mi.load_file(str(folder / "surrogate.xml"), parallel=False)
params, sensor = mi.traverse(scene), nf.SceneSensor(scene, place.mount, keys)
car = nf.Dubins(route.speed_ms, place.car.max_control)
loop = nf.ClosedLoop(sensor, driver, route.goal, car, nf.RK4(), place.period)
cost = nf.StageSum(nf.CrossTrackDeviation(route))
drive = nf.Rollout(loop, cost, horizon, adjoint=nf.KeptBackgrounds())


def error_path_traced():
    """Drive in meshes, the hydrants pasted; return the mean error in metres."""
    meshes = replace(place, scene=folder / "deployment.xml", camera=sensor.intrinsics)
    world = nf.make_environment("mitsuba", meshes, nf.Conditions(spp=8))
    world.show(sensor.objects)
    return nf.drive(world, driver, route, start, 0, horizon).distance_m.mean()


before = error_path_traced()
adam = mi.ad.Adam(lr=0.05, params={key: params[key] for key in keys})
for step in range(iterations + 1):
    params.update(adam)
    value = drive(params, loop.initial(start))  # minus the error, so it is minimised
    print(f"surrogate, step {step}: mean error {-value[0] / horizon:.3f} m")
    dr.backward(value)
    adam.step()
    for key in keys:
        adam[key] = dr.clip(adam[key], 0.01, 0.99)
after = error_path_traced()  # with the colours that were driven last
print(f"path-traced: mean error {before:.3f} m, attacked {after:.3f} m")
print(f"the failure {'transfers' if after > before + 0.1 else 'does not transfer'}")
