"""The reconstructed room at work: the policy's card, an attack, a film overlaid."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import tomlkit

from bench.commands.quality import run_command
from bench.phone.chain import placed_and_true
from bench.phone.film import ROOM, light_room
from bench.photographs import similarity
from mi_nerfattack.backend.colour import linear_to_uint8
from mi_nerfattack.deploy.driving import policy_image
from mi_nerfattack.experiment.run_folder import DRIVES, METRICS
from mi_nerfattack.experiment.transfer.found import read_found
from mi_nerfattack.io import files
from mi_nerfattack.io.video import write_video
from mi_nerfattack.render.camera.intrinsics import mount_matrix
from mi_nerfattack.robot.attacked import read_box
from mi_nerfattack.robot.overlay import Overlay
from mi_nerfattack.rollout.drive import ATTACK, NO_OBJECT
from mi_nerfattack.scenario.deployment import SURROGATE
from mi_nerfattack.scenario.world import build_world

_RAYS = 4  # through a pixel of the film that is overlaid
_STEP_M = 0.03  # of the march: half the time of the fit's own, 0.4 dB less
_SCENARIO = ROOM.parents[1] / "room.toml"


def write_scenario(folder: Path, field: Path) -> Path:
    """Write the bundled room's scenario with a field of the film as its surrogate.

    The field is turned and moved into the room's frame by the true places of the
    cameras, as by places that were measured; its scale stays as the markers told it.
    """
    found, given = placed_and_true(folder)
    _, turn = similarity(found.camera_to_world, given)
    matrix = np.eye(4)
    matrix[:3, :3] = turn.as_matrix()
    middle = found.camera_to_world[:, :3, 3].mean(0)
    matrix[:3, 3] = given[:, :3, 3].mean(0) - turn.apply(middle)
    table = tomlkit.parse(files.read_text(_SCENARIO))
    scene: Any = table["scene"]
    scene["field"], scene["to_world"] = str(field.resolve()), matrix.tolist()
    scene["step_m"] = _STEP_M
    path = folder / "room.toml"
    files.write_text(path, tomlkit.dumps(table))
    return path


def card(folder: Path, scenario: Path, runs: int) -> None:
    """Drive the policy in the field, without objects and past one of random looks."""
    path = folder / "card.json"
    if not path.is_file():
        words = ["evaluate", str(scenario), "--environments", SURROGATE]
        words += ["--runs", str(runs), "--drives", str(folder / "drives")]
        run_command([*words, "-o", str(path)])


def attack(folder: Path, scenario: Path) -> None:
    """Attack in the field, unless it is done."""
    run = folder / "run"
    if not (run / METRICS).is_file():
        run_command(["attack", str(scenario), "-o", str(run)])


def overlay(folder: Path) -> dict[str, Any]:
    """Put the attacked cube into films of drives, and compare what it does there.

    A film shows the room, which no frame of the capture shows from there, along a drive
    of the run past no object. At each frame the policy steers by the film, by the film
    with the cube pasted by pose, and by the surrogate without and with the cube.

    Returns:
        number of overlaid frames and of those whose steering the surrogate changes by
        more than a hundredth of its largest change; correlation of the changes, their
        standard deviations, radians; and the largest of each.
    """
    run = folder / "run"
    (found,) = read_found([run])
    world = build_world(found.scenario, found.scenario.build_policy())
    world.show(found.looks(world)[ATTACK])
    box, views = read_box(run)
    pasted = Overlay(box, views.camera, keyed=False)
    room = light_room(folder, views.camera, _RAYS, lambda *_: None)
    surrogates = [world.open(SURROGATE, empty) for empty in (True, False)]
    memory = world.policy.initial_memory(1)

    def steering(image: np.ndarray) -> float:
        row, _ = world.policy.step(policy_image(image), world.route.goal, memory)
        return float(np.array(row)[0])

    changes, frames = [], []
    for path in sorted((run / DRIVES).glob(f"{SURROGATE}_{NO_OBJECT}_*.safetensors")):
        states = files.read_safetensors(path, ["states"])[0]["states"][:, :3]
        for state in states:
            pose = mount_matrix(state[None], views.mount)[0]
            film = linear_to_uint8(room.picture(np.repeat(pose[None], _RAYS, 0)))
            frames.append(pasted.apply(film, pose))
            real = [steering(image) for image in (film, frames[-1])]
            seen = [steering(s.reset(world.route, state).image) for s in surrogates]
            changes.append((real[1] - real[0], seen[1] - seen[0]))
    write_video(folder / "overlaid.mp4", frames, 1 / views.period)
    real, seen = np.array(changes).T
    return {
        "overlaid": len(seen),
        "changed": int((np.abs(seen) > 0.01 * np.abs(seen).max()).sum()),
        "correlation": float(np.corrcoef(real, seen)[0, 1]),
        "film_sd_rad": float(real.std()),
        "surrogate_sd_rad": float(seen.std()),
        "film_most_rad": float(np.abs(real).max()),
        "surrogate_most_rad": float(np.abs(seen).max()),
    }
