"""Cameras and speed in, waypoints out: `two_cameras.py OUT [FRAMES [START]]` trains.

Without frames, OUT gets untrained weights.
"""

import sys

import torch
from safetensors.torch import load_file, save_file
from torch import nn
from torch.utils.data import DataLoader

import mi_nerfattack as nf


class Net(nn.Module):
    """Images 200x66 and 100x66 and speed (n, 1) to (n, 4, 2) metres ahead and left."""

    def __init__(self):
        super().__init__()
        layers = [nn.Conv2d(3, 24, 5, 2), nn.ELU(), nn.Conv2d(24, 36, 5, 2), nn.ELU()]
        layers += [nn.Conv2d(36, 48, 3, 2), nn.ELU(), nn.Conv2d(48, 48, 3), nn.ELU()]
        self.eye = nn.Sequential(*layers, nn.Flatten())
        middle = nn.Linear(48 * 4 * (21 + 8) + 1, 64)
        self.head = nn.Sequential(middle, nn.ELU(), nn.Linear(64, 8))

    def forward(self, front, wide, speed):
        seen = [self.eye(2 * image - 1) for image in (front, wide)]
        steps = self.head(torch.cat([*seen, speed / 10], 1))
        straight = speed[:, None] * steps.new_tensor([[0.5], [1.0], [1.5], [2.0]])
        return nn.functional.pad(straight, (0, 1)) + steps.unflatten(1, (4, 2))


def train(network, data, epochs=12):
    """Imitate the expert's positions on frames, two images side by side in each."""
    frames = nf.frames(data)
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    rate = torch.optim.lr_scheduler.OneCycleLR(adam, 2e-3, epochs * (len(frames) // 32))
    for epoch in range(epochs):
        total = 0.0
        for batch in DataLoader(frames, 32, shuffle=True, drop_last=True):
            front, wide = batch.image.split([200, 100], dim=3)
            path = network(front, wide, batch.speed[:, None])
            error = (path - batch.waypoints).norm(dim=2).mean()
            adam.zero_grad()
            error.backward()
            adam.step()
            rate.step()
            total += error.item()
        print(f"epoch {epoch + 1}: {total / (len(frames) // 32):.3f} m")


if __name__ == "__main__":
    torch.manual_seed(0)
    net, (out, *rest) = Net(), sys.argv[1:]
    if len(rest) > 1:
        net.load_state_dict(load_file(rest[1]))
    if rest:
        train(net, rest[0])
    save_file(net.state_dict(), out)
