"""A policy of your own and its training, which `retrain --command` can call."""

import sys

import torch
from safetensors.torch import load_file, save_file
from torch import nn
from torch.utils.data import DataLoader

import mi_nerfattack as nf

EPOCHS = 4


class Net(nn.Module):
    """Images (n, 3, 66, 200) in, sRGB in [0, 1]; heading rates (n,) out, rad/s."""

    def __init__(self):
        super().__init__()
        self.layers = nn.Sequential(
            *(nn.Conv2d(3, 16, 5, 3), nn.ELU()),
            *(nn.Conv2d(16, 32, 5, 3), nn.ELU(), nn.Flatten()),
            nn.Linear(32 * 6 * 21, 1),
        )

    def forward(self, image):
        return 1.5 * torch.tanh(self.layers(2 * image - 1)[:, 0])


def train(data, out, seed, start=None):
    """Imitate the expert on the frames of a folder, and write the weights."""
    torch.manual_seed(seed)
    network = Net()
    if start is not None:
        network.load_state_dict(load_file(start))
    adam = torch.optim.Adam(network.parameters(), lr=1e-3)
    frames = nf.frames(data)
    for epoch in range(EPOCHS):
        total = 0.0
        for batch in DataLoader(frames, batch_size=32, shuffle=True):
            error = (network(batch.image) - batch.control).square().sum()
            adam.zero_grad()
            error.backward()
            adam.step()
            total += error.item()
        print(f"epoch {epoch + 1}: rms error {(total / len(frames)) ** 0.5:.4f} rad/s")
    save_file(network.state_dict(), out)


if __name__ == "__main__":
    data, out, seed, *start = sys.argv[1:]
    train(data, out, int(seed), *start)
