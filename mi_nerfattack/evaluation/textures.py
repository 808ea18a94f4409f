"""What an attack made of its textures, for ``metrics.json``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from mi_nerfattack.attack.texture.statistics import seen_weights, texture_statistics
from mi_nerfattack.rollout.drive import OWN, Drive
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import Appearance, World
from mi_nerfattack.vehicle.state import to_state

#: Frames of the first unattacked drive that say what of a texture is seen.
FRAMES = 16


def texture_figures(
    world: World, drives: Sequence[Drive], own: Appearance, attacked: Appearance
) -> dict[str, Any]:
    """Judge the textures by what the camera of the unattacked drive sees of them.

    Args:
        world: what was driven in; its objects look attacked afterwards.
        drives: the run's; the first of the case `own` in the surrogate is looked at.
        own: how the objects look by themselves.
        attacked: how the attack leaves them.

    Returns:
        ``textures`` by object, with the ``picture_share`` that it takes on average,
        and ``saturated_share`` and ``total_variation``, means over the objects.
    """
    driven = next(d for d in drives if d.case == OWN and d.environment == SURROGATE)
    picked = np.unique(np.linspace(0, len(driven.states) - 1, FRAMES).astype(int))
    world.show(own)
    states = [to_state(driven.states[None, step]) for step in picked]
    weights = seen_weights(world.surrogate, world.fields, states)
    world.show(attacked)
    camera = world.surrogate.intrinsics
    # A colour's sigmoid rises by a quarter there, in each channel of a pixel it fills.
    filled = 3 / 4 * camera.width * camera.height * len(states)
    found = {
        item.id: asdict(texture_statistics(field, original, weight))
        | {"picture_share": float(np.clip(weight.sum() / filled, 0, 1))}
        for item, field, original, weight in zip(
            world.scenario.objects, world.fields, own.textures, weights, strict=True
        )
    }
    names = ("saturated_share", "total_variation")
    means = {
        name: float(np.mean([figures[name] for figures in found.values()]))
        for name in names
    }
    return {"textures": found, **means}
