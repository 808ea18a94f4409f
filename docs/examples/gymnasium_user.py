"""Search the gains of a controller in a Gymnasium environment, then film the best."""

import gymnasium
import numpy as np
from PIL import Image

EPISODES, STEPS = 6, 50

world = gymnasium.make(
    "mi_nerfattack.deploy.gym:mi_nerfattack/surrogate-v0",
    routes=["right"],
    max_steps=STEPS,
    render_mode="rgb_array",
)
print(
    "observation:", {name: box.shape for name, box in world.observation_space.items()}
)


def episode(gains, on_frame=None):
    """Return the sum of rewards: of each step, 1 in the middle of the lane."""
    start = world.unwrapped.routes["right"].pose_at(12.0, lateral=0.5)
    _, info = world.reset(seed=0, options={"route": "right", "pose": start})
    total, before = 0.0, info["cross_track_m"]
    while True:
        error = info["cross_track_m"]  # metres to the left; a policy has the image
        steer = -gains @ [error, error - before]
        observation, reward, left, over, info = world.step(np.clip([steer], -1, 1))
        total, before = total + reward, error
        if on_frame:
            on_frame(observation["image"])
        if left or over:
            return total


rng = np.random.default_rng(0)
gains, best = np.zeros(2), -np.inf
for number in range(EPISODES):
    tried = np.abs(gains + rng.normal(0, [0.5, 5.0]))
    score = episode(tried)
    if score > best:
        gains, best = tried, score
    print(f"episode {number}: gains {tried.round(2)}, return {score:.1f}")

frames = []
print(f"best: gains {gains.round(2)}, return {episode(gains, frames.append):.1f}")
film = [Image.fromarray(frame) for frame in frames]
film[0].save("drive.gif", save_all=True, append_images=film[1:], duration=100)
world.close()
