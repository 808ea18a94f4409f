"""Train a small waypoint network of your own on frames of this package."""

from dataclasses import replace

import torch
from torch import nn
from torch.utils.data import DataLoader

import mi_nerfattack as nf
from mi_nerfattack import deploy, system, training
from mi_nerfattack.training.collect import collect

FRAMES, EPOCHS = 64, 25

nf.variant.ensure()
torch.set_num_threads(1)  # the network is small
torch.manual_seed(0)
camera = nf.Camera(80, 40, fx=60.0, fy=60.0, cx=40.0, cy=20.0)
mount = nf.CameraMount(height_m=1.3)
place = replace(nf.bundled_place(), camera=camera, mount=mount)
collect(
    deploy.PlaceSite("surrogate", place),
    nf.load_routes(place.routes),
    training.ExpertDrives(horizon=8),  # recoveries from beside the lane
    training.CollectSettings(frames=FRAMES, shard=32, object_share=0.0),
    "frames",
    system.InThisProcess(),
)
frames = nf.frames("frames", window=2)  # each with the frame before it


class WayNet(nn.Module):
    """Two images and the speed in, positions (k, 2) in metres out."""

    def __init__(self, k):
        super().__init__()
        self.features = nn.Sequential(nn.Conv2d(6, 16, 5, 3), nn.ReLU(), nn.Flatten())
        self.head = nn.Sequential(nn.LazyLinear(64), nn.ReLU(), nn.Linear(64, 2 * k))

    def forward(self, images, speed):  # (n, 2, 3, 40, 80) sRGB in [0, 1], (n,) m/s
        features = self.features(images.flatten(1, 2))
        return self.head(torch.cat([features, speed[:, None]], 1)).unflatten(1, (-1, 2))


def distance(batch):
    """Return the mean distance from the expert's positions, metres."""
    return (network(batch.image, batch.speed) - batch.waypoints).norm(dim=-1).mean()


network = WayNet(len(frames.waypoints_s))
(everything,) = DataLoader(frames, batch_size=FRAMES)
print(f"before: {distance(everything).item():.3f} m")
adam = torch.optim.Adam(network.parameters(), lr=3e-3)
for _ in range(EPOCHS):
    for batch in DataLoader(frames, batch_size=16, shuffle=True):
        adam.zero_grad()
        distance(batch).backward()
        adam.step()
print(f"after: {distance(everything).item():.3f} m")
