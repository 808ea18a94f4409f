"""Attack a PyTorch policy of one's own by autograd through the closed loop."""

import drjit as dr
import mitsuba as mi
import torch
from torch import nn

from mi_nerfattack import attack, policy, rollout, scenario, scenes
from mi_nerfattack.vehicle.dynamics import state_type

mi.set_variant("llvm_ad_rgb")
HORIZON, ITERATIONS = 25, 4  # control periods of 0.1 s, steps of Adam


class Damped(nn.Module):
    """Your network: here a trained one whose output is smoothed over time."""

    def __init__(self):
        super().__init__()
        weights = scenes.bundled("policy/pilotnet.safetensors")
        self.network = policy.PilotNet.load(weights)

    def forward(self, image, goal, last):  # (n, 3, 66, 200) sRGB, (n,), (n, 1)
        control = 0.8 * self.network(image, goal).reshape(-1, 1) + 0.2 * last
        return control, control  # rad/s to the left, and the next hidden state


described, _ = scenario.load_scenario(scenes.bundled("base.toml"))
mine = policy.TorchPolicy(Damped(), policy.IntegerGoal(3), recurrent=[(-1, 1)])
world = scenario.build_world(described, mine)
drives = rollout.Rollout(
    world.loop(world.surrogate),
    rollout.StageSum(attack.CrossTrackDeviation(world.route)),
    HORIZON,
    adjoint=rollout.KeptBackgrounds(),
)
(key,) = world.surrogate.keys  # of the hydrant's colours, sRGB in (0, 1)


@dr.wrap(source="torch", target="drjit")
def objective(colour, start):
    """Sum up costs; smaller where the policy is farther from its lane."""
    return drives({key: colour}, state_type()(start))


colour = torch.tensor(world.surrogate.params[key].numpy(), requires_grad=True)
# x, y in metres, heading in radians; a row a drive
start = torch.tensor(world.route.pose_at([20.0]), requires_grad=True)
adam = torch.optim.Adam([colour], lr=0.05)
for iteration in range(ITERATIONS + 1):
    adam.zero_grad()
    value = objective(colour, start.T)
    value.backward()
    adam.step()
    colour.data.clamp_(0.01, 0.99)
    print(f"iteration {iteration}: mean error {-value.item() / HORIZON:.3f} m")

print("by the colours:", tuple(colour.grad.shape), f"{colour.grad.abs().sum():.2e}")
print("by the starting pose:", start.grad[0].numpy().round(2).tolist())
