"""Bundled policies, their records, their cards and the manifest tell one story."""

from __future__ import annotations

import re
from typing import Any

import pytest

from mi_nerfattack.fields import load_field
from mi_nerfattack.io import files
from mi_nerfattack.scenes import bundled, manifest
from mi_nerfattack.training.record import TrainingRecord, read_record

FILES = manifest.load()
#: Policies by name: where they were trained, and objects of other folders.
POLICIES = {
    "policy/pilotnet": ("intersection", {"car", "cube", "hydrant"}),
    "room/policy": ("room", {"cube"}),
}
every_policy = pytest.mark.parametrize("name", POLICIES)


def record_and_card(name: str) -> tuple[TrainingRecord, dict[str, Any]]:
    record = read_record(bundled(f"{name}.json"))
    assert record is not None
    return record, files.read_json(bundled(f"{name}.card.json"))


@every_policy
def test_the_policy_is_that_of_record_and_card(name: str) -> None:
    (record, card), policy = record_and_card(name), f"{name}.safetensors"
    assert card["policy_section"]["file_sha256"] == FILES[policy]["sha256"]
    for file in (policy, f"{name}.json"):
        assert FILES[file]["command"] == record.command
        assert FILES[file]["seed"] == record.seed
    assert card["training"]["command"] == record.command
    assert sum(record.data.values()) == int(
        re.search(r"(\d+) frames", FILES[policy]["note"])[1]
    )


@every_policy
def test_the_record_is_of_the_files_that_are_bundled(name: str) -> None:
    place, objects = POLICIES[name]
    record, _ = record_and_card(name)
    bundled_sums = {
        file.removeprefix(f"{place}/"): entry["sha256"] for file, entry in FILES.items()
    }
    for file, digest in record.checksums.items():
        assert bundled_sums[file.removeprefix(f"{place}/")] == digest, file
    folders = {file.partition("/")[0] for file in record.checksums}
    assert folders & {"car", "cube", "hydrant"} == objects


@every_policy
def test_the_card_is_of_the_command_in_the_manifest(name: str) -> None:
    _, card = record_and_card(name)
    for file in (f"{name}.card.json", f"{name}.png"):
        assert FILES[file]["command"] == card["command"]
        assert FILES[file]["seed"] == card["settings"]["seed"]
    found = {file.partition("/")[0] for file in card["place"]}
    assert found >= POLICIES[name][1] - {"hydrant"}


@pytest.mark.parametrize(
    "name", [n for n in sorted(FILES) if n.endswith("field.safetensors")]
)
@pytest.mark.usefixtures("variant")
def test_notes_of_fields_say_what_their_headers_say(name: str) -> None:
    info, note = load_field(bundled(name)).info, FILES[name]["note"]
    found = re.search(r"held-out ([\d.]+) dB, SSIM ([\d.]+)", note)
    assert found is not None
    assert float(found[1]) == round(float(info["fit.psnr_heldout_db"]), 1)
    assert float(found[2]) == round(float(info["fit.ssim_heldout"]), 3)
