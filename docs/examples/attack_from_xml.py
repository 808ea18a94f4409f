"""Attack two hydrants of a Mitsuba scene, then drive past them path-traced."""

import sys
from dataclasses import replace
from pathlib import Path

from mi_nerfattack import attack, deploy, policy, rollout, scenes, vehicle

# isort: split
import drjit as dr
import mitsuba as mi

mi.set_variant("llvm_ad_rgb")
horizon, iterations = map(int, sys.argv[1:] or (40, 12))
here, place, names = Path(__file__).parent, deploy.bundled_place(), ["near", "far"]
route = vehicle.Route.from_file(place.routes, "right")
network = policy.PilotNet.load(scenes.bundled("policy/pilotnet.safetensors"))
driver, start = policy.TorchPolicy(network), route.pose_at(6.0)

scene = mi.load_file(str(here / "surrogate.xml"), parallel=False)
sensor = attack.surrogate_sensor(scene, place.mount, names)
car = vehicle.Dubins(route.speed_ms, place.car.max_control)
parts = sensor, driver, route.goal, car, vehicle.RK4(), place.period
loop = rollout.ClosedLoop(*parts)
cost = rollout.StageSum(attack.CrossTrackDeviation(route))
drive = rollout.Rollout(loop, cost, horizon, adjoint=rollout.KeptBackgrounds())


def error_path_traced():
    """Drive in meshes, the hydrants pasted; return the mean error in metres."""
    meshes = replace(place, scene=here / "deployment.xml", camera=sensor.camera)
    world = deploy.make_environment("mitsuba", meshes, deploy.Conditions(spp=8))
    world.show(sensor.objects)
    return deploy.drive(world, driver, route, start, 0, horizon).distance_m.mean()


given = dict(zip(names, sensor.textures(), strict=True))
textures = mi.ad.Adam(lr=0.05, params=given)
before, costs = error_path_traced(), []
for _ in range(iterations + 1):
    value = drive([textures[name] for name in names], loop.initial(start))
    costs.append(-value[0] / horizon)
    print(f"surrogate, step {len(costs) - 1}: mean error {costs[-1]:.3f} m")
    dr.backward(value)
    textures.step()
after = error_path_traced()  # with the textures that were driven last
print(f"path-traced: mean error {before:.3f} m, attacked {after:.3f} m")
print(f"the failure {'transfers' if after > before + 0.1 else 'does not transfer'}")
