"""Attack the bitmap of a billboard in path-traced streets, through Mitsuba's prb."""

import sys
from pathlib import Path

import mi_nerfattack as nf  # before drjit, since it chooses the LLVM

# isort: split
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
horizon, iterations = map(int, sys.argv[1:] or (30, 8))
place, key = nf.bundled_place(), "board.bsdf.brdf_0.reflectance.data"
route = nf.Route.from_file(place.routes, "right")
driver = nf.TorchPolicy(nf.PilotNet.load(nf.bundled("policy/pilotnet.safetensors")))

file = Path(__file__).with_name("billboard.xml")
scene, prb = mi.load_file(str(file), parallel=False), {"type": "prb", "max_depth": 3}
sensor = nf.SceneSensor(scene, place.mount, integrator=mi.load_dict(prb))
car = nf.Dubins(route.speed_ms, place.car.max_control)
loop = nf.ClosedLoop(sensor, driver, route.goal, car, nf.RK4(), place.period)
drive = nf.Rollout(loop, nf.StageSum(nf.CrossTrackDeviation(route)), horizon)

params, start = mi.traverse(scene), loop.initial(route.pose_at(12.0))
adam = mi.ad.Adam(lr=0.1, params={key: params[key]})
for step in range(iterations + 1):
    params.update(adam)
    value = drive(params, start)  # minus the error, so it is minimised
    print(f"step {step}: mean error {-value[0] / horizon:.3f} m")
    dr.backward(value)
    adam.step()
    adam[key] = dr.clip(adam[key], 0.01, 0.99)
mi.util.write_bitmap("billboard.png", params[key])
