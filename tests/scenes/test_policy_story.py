"""The bundled policy, its record, its card and the manifest tell one story."""

from __future__ import annotations

import re

import pytest

from mi_nerfattack.fields import load_field
from mi_nerfattack.io import files
from mi_nerfattack.scenes import bundled, manifest
from mi_nerfattack.training.record import read_record

POLICY = "policy/pilotnet.safetensors"
FILES = manifest.load()
RECORD = read_record(bundled("policy/pilotnet.json"))
CARD = files.read_json(bundled("policy/pilotnet.card.json"))


def test_the_policy_is_that_of_record_and_card() -> None:
    assert RECORD is not None
    assert CARD["policy_section"]["file_sha256"] == FILES[POLICY]["sha256"]
    for name in (POLICY, "policy/pilotnet.json"):
        assert FILES[name]["command"] == RECORD.command
        assert FILES[name]["seed"] == RECORD.seed
    assert CARD["training"]["command"] == RECORD.command
    assert sum(RECORD.data.values()) == int(
        re.search(r"(\d+) frames", FILES[POLICY]["note"])[1]
    )


def test_the_record_is_of_the_files_that_are_bundled() -> None:
    assert RECORD is not None
    bundled_sums = {
        name.removeprefix("intersection/"): entry["sha256"]
        for name, entry in FILES.items()
    }
    for name, digest in RECORD.checksums.items():
        assert bundled_sums[name.removeprefix("intersection/")] == digest, name
    objects = {name for name in RECORD.checksums if name.startswith(("car", "cube"))}
    assert objects == {"car/field.safetensors", "cube/field.safetensors"}


def test_the_card_is_of_the_command_in_the_manifest() -> None:
    for name in ("policy/pilotnet.card.json", "policy/pilotnet.png"):
        assert FILES[name]["command"] == CARD["command"]
        assert FILES[name]["seed"] == CARD["settings"]["seed"]
    assert {"car/field.safetensors", "cube/field.safetensors"} < set(CARD["place"])


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
